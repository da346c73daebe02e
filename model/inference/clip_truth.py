"""What a dataset knows of the object in one of its clips; images alone tell neither size nor truth."""

from model.data.batch import SurfaceTarget
from model.data.reader import SURFACE_COLUMNS, surface_target
from model.video.frames import VideoFrames
from shards.reader import find_clip, open_shards

__all__ = ["clip_truth"]


def clip_truth(frames: VideoFrames) -> SurfaceTarget | None:
    """The true surface, and metres per canonical unit; None for anything but a clip. ShardError.

    For the result's record and for metrics, never an input of the networks.
    """
    if frames.kind != "clip":
        return None
    address, _, clip_id = frames.source.rpartition("#")
    shard = find_clip(open_shards(address), clip_id, where=address)
    return surface_target(shard.read_object(shard.read_clip(clip_id).object_uid, SURFACE_COLUMNS))
