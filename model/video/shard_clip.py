"""Frames of a clip of a dataset: the same images that a video of it would show, and nothing else."""

from collections.abc import Sequence
from difflib import get_close_matches

from model.errors import ModelError
from model.video.frames import (
    ReadLimits,
    VideoFrame,
    VideoFrames,
    checked_indices,
    even_positions,
    scaled_down,
)
from shards.reader import Shard, open_dataset, open_shard

__all__ = ["read_clip", "shards_at"]


def read_clip(address: str, clip_id: str, limits: ReadLimits, indices: Sequence[int] | None) -> VideoFrames:
    """The frames `indices` of a clip, or candidates spread over it. `address`: a dataset or a shard.

    Raises ModelError for an unknown clip or frame, ShardError for damaged data.
    """
    source = f"{address}#{clip_id}"
    frames = _shard_of(address, clip_id).read_frames(clip_id, ("rgb", "time_s"))
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


def shards_at(address: str) -> tuple[Shard, ...]:
    """Finished shards of a dataset, or the one shard that `address` names. Raises ShardError."""
    name = address.rstrip("/").rsplit("/", 1)[-1]
    return (open_shard(address),) if name.startswith("shard-") else open_dataset(address).shards


def _shard_of(address: str, clip_id: str) -> Shard:
    shards = shards_at(address)
    for shard in shards:
        if clip_id in shard.record.clip_ids:
            return shard
    known = [clip for shard in shards for clip in shard.record.clip_ids]
    close = get_close_matches(clip_id, known, n=1)
    hint = f"Did you mean '{close[0]}'?" if close else f"The first one is '{known[0] if known else ''}'."
    raise ModelError(address, f"no clip '{clip_id}'", expected=f"one of its {len(known)} clips", action=hint)
