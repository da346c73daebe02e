"""Contact sheet: a row of plain images and a row of labelled ones for every chosen clip."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from datagen.inspection.overlay import draw_labels
from shards.reader import Frames, Shard
from shards.schema import ClipRow

__all__ = ["contact_sheet", "labelled_frame", "write_png"]

CAPTION_PX = 22
FRAME_COLUMNS = ("rgb", "masks", "joints_px", "T_cam_from_world", "T_world_from_obj")


def contact_sheet(
    shard: Shard, *, n_clips: int, n_frames: int, tile_px: int
) -> UInt8[np.ndarray, "height width 3"]:
    """`n_clips` clips spread over the shard, `n_frames` moments of each: plain above, labelled below."""
    clips = shard.clips()
    chosen = [
        clips[i]
        for i in np.unique(np.linspace(0, len(clips) - 1, min(n_clips, len(clips))).round().astype(int))
    ]
    rows = [_clip_rows(shard, clip, n_frames, tile_px) for clip in chosen]
    return np.concatenate(rows, axis=0)


def labelled_frame(
    clip: ClipRow, frames: Frames, index: int, axis_length_m: float, *, zoom: int = 1
) -> UInt8[np.ndarray, "height width 3"]:
    """One image of a clip with its labels."""
    return draw_labels(
        frames.rgb(index),
        frames.masks(index),
        np.asarray(frames["joints_px"][index], dtype=np.float64),
        frames["T_cam_from_world"][index] @ frames["T_world_from_obj"][index],
        clip.K,
        axis_length_m,
        zoom=zoom,
    )


def write_png(path: Path, rgb: UInt8[np.ndarray, "height width 3"]) -> None:
    """Write an image for people; OSError when the path cannot be written."""
    ok, data = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    if not ok:
        raise OSError(f"{path}: cannot encode an image of shape {rgb.shape}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.tobytes())


def _clip_rows(
    shard: Shard, clip: ClipRow, n_frames: int, tile_px: int
) -> UInt8[np.ndarray, "height width 3"]:
    frames = shard.read_frames(clip.clip_id, FRAME_COLUMNS)
    axis_m = 0.5 * float(shard.read_object(clip.object_uid, ["object_scale_m"])["object_scale_m"][0])
    moments: list[int] = np.linspace(0, clip.n_frames - 1, n_frames).round().astype(int).tolist()
    zoom = max(1, round(2 * tile_px / clip.image_width))
    plain = [_tile(frames.rgb(i), tile_px) for i in moments]
    labelled = [_tile(labelled_frame(clip, frames, i, axis_m, zoom=zoom), tile_px) for i in moments]
    image = np.concatenate([np.concatenate(plain, axis=1), np.concatenate(labelled, axis=1)], axis=0)
    caption = np.full((CAPTION_PX, image.shape[1], 3), 32, np.uint8)
    text = (
        f"{clip.clip_id}   {clip.object_uid}   {clip.camera_kind}   {clip.hdri}   "
        f"{clip.table_material or 'no table'}   visible {clip.object_visible_fraction_mean:.2f}"
    )
    cv2.putText(caption, text, (6, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (235, 235, 235), 1, cv2.LINE_AA)
    return np.concatenate([caption, image], axis=0)


def _tile(rgb: UInt8[np.ndarray, "height width 3"], tile_px: int) -> UInt8[np.ndarray, "tall wide 3"]:
    height, width = rgb.shape[:2]
    shrinks = width > tile_px
    interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
    return cv2.resize(rgb, (tile_px, round(tile_px * height / width)), interpolation=interpolation)
