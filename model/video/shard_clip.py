"""Frames of a clip of a dataset: the same images that a video of it would show, and nothing else."""

from collections.abc import Sequence

from model.video.frames import (
    ReadLimits,
    VideoFrame,
    VideoFrames,
    checked_indices,
    even_positions,
    scaled_down,
)
from shards.reader import find_clip, open_shards

__all__ = ["read_clip"]


def read_clip(address: str, clip_id: str, limits: ReadLimits, indices: Sequence[int] | None) -> VideoFrames:
    """The frames `indices` of a clip, or candidates spread over it. `address`: a dataset or a shard.

    Raises ModelError for an unknown frame, ShardError for an unknown clip or damaged data.
    """
    source = f"{address}#{clip_id}"
    shard = find_clip(open_shards(address), clip_id, where=address)
    frames = shard.read_frames(clip_id, ("rgb", "time_s"))
    n = len(frames)
    wanted = even_positions(n, limits.max_frames)
    if indices is not None:
        wanted = checked_indices(indices, n, source)
    images = []
    for index in wanted:
        full = frames.rgb(index)
        image = scaled_down(full, limits.max_side_px)
        changes = []
        if image.shape != full.shape:
            small = f"{image.shape[1]} x {image.shape[0]}"
            changes.append(f"scaled down from {full.shape[1]} x {full.shape[0]} to {small}")
        images.append(
            VideoFrame(
                image=image,
                index=index,
                time_s=float(frames["time_s"][index]),
                name=f"frame {index}",
                source_size=(full.shape[1], full.shape[0]),
                changes=tuple(changes),
            )
        )
    return VideoFrames(source=source, kind="clip", frames=tuple(images), n_source_frames=n, notes=())
