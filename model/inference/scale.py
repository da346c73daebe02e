"""The size of an object where its source says it; images alone do not."""

from dataclasses import dataclass

from model.video.frames import VideoFrames
from shards.reader import find_clip, open_shards

__all__ = ["KnownScale", "known_scale"]


@dataclass(frozen=True, kw_only=True)
class KnownScale:
    """Metres along a canonical unit, and who says so."""

    metres_per_unit: float
    origin: str


def known_scale(frames: VideoFrames) -> KnownScale | None:
    """The annotation of a clip; None for anything else. It is passed on, never used. ShardError."""
    if frames.kind != "clip":
        return None
    address, _, clip_id = frames.source.rpartition("#")
    shard = find_clip(open_shards(address), clip_id, where=address)
    of_object = shard.read_object(shard.read_clip(clip_id).object_uid, ("object_scale_m",))
    metres = float(of_object["object_scale_m"][0])
    return KnownScale(metres_per_unit=metres, origin="annotation of the dataset, not the images")
