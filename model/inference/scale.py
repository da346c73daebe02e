"""The size of an object where its source says it; images alone do not."""

from dataclasses import dataclass

from model.video.frames import VideoFrames
from model.video.shard_clip import shards_at

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
    shard = next(shard for shard in shards_at(address) if clip_id in shard.record.clip_ids)
    clips = shard.read_clips(("clip_id", "object_uid"))
    uid = clips["object_uid"][clips["clip_id"].index(clip_id)]
    objects = shard.read_objects(("object_uid", "object_scale_m"))
    metres = float(objects["object_scale_m"][objects["object_uid"].index(uid)])
    return KnownScale(metres_per_unit=metres, origin="annotation of the dataset, not the images")
