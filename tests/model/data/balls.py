"""Datasets of balls held by balls (tests/shards/synthetic.py), with the splits and shards a test asks for."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

from model.data.batch import Batch
from model.data.config import DataConfig, StreamConfig
from model.data.crop import Augmentation
from model.data.stream import ShardStream
from shards.schema import ClipRow, FrameRow, ObjectRow
from shards.splits import Split, SplitRule, split_of_object
from shards.writer import begin_dataset, commit_shard, stage_motion
from tests.shards.synthetic import (
    PROVENANCE,
    SPLIT_RULE,
    dataset_record,
    synthetic_clip,
    synthetic_object,
)

VARIED = Augmentation(margin=(1.1, 1.6), shift=0.7, roll_deg=(-40.0, 40.0), flip_probability=0.5)


def data_config(*datasets: object, **changes: object) -> DataConfig:
    """The training motions of small datasets, no camera held out."""
    settings: dict[str, object] = {
        "datasets": tuple(str(dataset) for dataset in datasets),
        "split": "train",
        "held_out_cameras": 0.0,
        "seed": 5,
        "augmentation": VARIED,
        "samples_per_motion": 1,
        "workers": 0,
        "prefetch_batches": 1,
        "cache_mb": 64,
        "max_corrupt": 0,
    }
    return DataConfig(**(settings | changes))  # type: ignore[arg-type]


def stream_config(*datasets: object, **changes: object) -> StreamConfig:
    """A small stream over all cameras of the training motions."""
    settings: dict[str, object] = {
        "held_out_cameras": 0.2,
        "cameras": "all",
        "batch_size": 4,
        "views": (2, 4),
        "image_size": 32,
        "endless": True,
    }
    return StreamConfig(**(vars(data_config(*datasets)) | settings | changes))


def take(stream: ShardStream, n: int) -> list[Batch]:
    """The next n batches, and the end of the loader processes."""
    try:
        return list(islice(stream, n))
    finally:
        stream.close()


def uid_of_split(split: Split, number: int, rule: SplitRule = SPLIT_RULE) -> str:
    """The `number`-th name that the rule puts into `split`."""
    names = (f"ball-{i}" for i in range(10_000))
    return [name for _, name in zip(range(10_000), names) if split_of_object(name, rule) == split][number]


def write_balls(
    root: Path,
    *,
    splits: Sequence[Sequence[Split]] = (("train", "train"), ("train", "val")),
    cameras: int = 3,
    n_frames: int = 3,
    size_px: int = 40,
    rule: SplitRule = SPLIT_RULE,
    change_frame: Callable[[FrameRow], FrameRow] = lambda frame: frame,
    change_object: Callable[[ObjectRow], ObjectRow] = lambda row: row,
) -> Path:
    """One shard per entry of `splits`, one motion per split in it, each with an object of its own."""
    begin_dataset(root, replace(dataset_record(), split_rule=rule))
    motion = 0
    used = {"train": 0, "val": 0, "test": 0}
    for shard, motion_splits in enumerate(splits):
        first = motion
        for split in motion_splits:
            uid = uid_of_split(split, used[split], rule)
            used[split] += 1
            row = change_object(replace(synthetic_object(motion), object_uid=uid))
            _stage(root, shard, motion, row, split, cameras, n_frames, size_px, change_frame)
            motion += 1
        commit_shard(root, shard, motion_indices=range(first, motion), provenance=PROVENANCE)
    return root


def _stage(
    root: Path,
    shard: int,
    motion: int,
    object_row: ObjectRow,
    split: Split,
    cameras: int,
    n_frames: int,
    size_px: int,
    change_frame: Callable[[FrameRow], FrameRow],
) -> None:
    clips: list[ClipRow] = []
    frames: list[FrameRow] = []
    for camera in range(cameras):
        clip, clip_frames = synthetic_clip(object_row, motion, camera, n_frames, size_px)
        clips.append(replace(clip, split=split))
        frames.extend(change_frame(frame) for frame in clip_frames)
    stage_motion(
        root,
        shard,
        motion,
        object_row=object_row,
        clips=clips,
        frames=frames,
        timings_s={},
        provenance=PROVENANCE,
    )
