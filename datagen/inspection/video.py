"""A clip as an MP4 film: plain on the left, labelled on the right."""

from pathlib import Path

import cv2
import numpy as np

from datagen.inspection.sheet import FRAME_COLUMNS, labelled_frame
from shards.errors import StorageError
from shards.reader import Shard

__all__ = ["write_video"]


def write_video(shard: Shard, clip_id: str, path: Path, *, repeats: int) -> None:
    """Write `clip_id` (`repeats` times over, since clips are short). StorageError when it cannot be written;
    DatasetNotFoundError when there is no such clip.
    """
    clip = shard.read_clip(clip_id)
    frames = shard.read_frames(clip_id, FRAME_COLUMNS)
    axis_m = 0.5 * float(shard.read_object(clip.object_uid, ["object_scale_m"])["object_scale_m"][0])
    size = (2 * clip.image_width, clip.image_height)
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), clip.fps, size)
    if not writer.isOpened():
        raise StorageError(
            "cannot be written as MP4", where=str(path), fix="name a writable file ending in .mp4"
        )
    try:
        for index in [*range(clip.n_frames)] * repeats:
            image = np.concatenate([frames.rgb(index), labelled_frame(clip, frames, index, axis_m)], axis=1)
            writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    finally:
        writer.release()
