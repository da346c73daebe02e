"""MotionIndex: every motion a stream can draw from, and where its clips are.

Built once in the main process from clips.parquet alone; small enough to send to loader workers.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

from model.data.config import Cameras, StreamConfig
from model.errors import ModelError
from shards.errors import CorruptShardError, MissingColumnError
from shards.reader import Shard, open_shards
from shards.splits import ObjectSplits, Split

__all__ = ["FRAME_COLUMNS", "MotionIndex", "MotionRef", "open_motions"]

FRAME_COLUMNS = (
    "T_cam_from_world",
    "T_world_from_obj",
    "joints_px",
    "hand_box_visible_px",
    "object_box_amodal_px",
    "rgb",
    "masks",
)
_CLIP_COLUMNS = ("motion_id", "camera_index", "object_uid", "split", "n_frames")
_READERS = 8  # shards opened at once; what counts is the latency of remote storage


@dataclass(frozen=True, kw_only=True, slots=True)
class MotionRef:
    """One motion as far as a stream may use it."""

    shard: int  # into MotionIndex.shards
    motion_id: str
    object_uid: str
    split: Split
    clip_rows: tuple[int, ...]  # rows of clips.parquet = row groups of frames.parquet, by camera index
    frame_counts: tuple[int, ...]  # of those clips

    @property
    def n_frames(self) -> int:
        """Frames of all its cameras: what views are drawn from."""
        return sum(self.frame_counts)


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionIndex:
    """Motions in file order."""

    shards: tuple[Shard, ...]
    motions: tuple[MotionRef, ...]


def open_motions(config: StreamConfig) -> MotionIndex:
    """The motions of `config.split`, with the cameras it asks for.

    Raises ModelError when there is no motion or one has fewer frames than views are wanted; SplitError when an
    object is in two splits, over all datasets; ShardError for missing, damaged or incomplete data.
    """
    shards = tuple(shard for url in config.datasets for shard in open_shards(url))
    with ThreadPoolExecutor(_READERS) as pool:
        found = list(pool.map(_motions_of_shard, range(len(shards)), shards))
    splits = ObjectSplits()
    for motion in (motion for motions in found for motion in motions):
        splits.add(motion.object_uid, motion.split, where=shards[motion.shard].path)
    of_split = [motion for motions in found for motion in motions if motion.split == config.split]
    chosen = [
        motion
        for motion in (_with_cameras(m, config.cameras, config.held_out_cameras) for m in of_split)
        if motion.clip_rows
    ]
    _check_enough(chosen, found, config)
    # `replace` drops the file footers that were cached on the way, so little is sent to the workers
    return MotionIndex(shards=tuple(replace(shard) for shard in shards), motions=tuple(chosen))


def _motions_of_shard(number: int, shard: Shard) -> list[MotionRef]:
    present = shard.source("frames").schema.names
    for column in FRAME_COLUMNS:
        if column not in present:
            raise MissingColumnError(
                "a column that training needs is missing",
                where=shard.source("frames").path,
                column=column,
                fix="make the shard again with this version of datagen",
            )
    table = shard.read_clips(_CLIP_COLUMNS)
    columns = {name: list(table[name]) for name in _CLIP_COLUMNS}
    rows_of_motion: dict[str, list[int]] = {}
    for row, motion_id in enumerate(columns["motion_id"]):
        rows_of_motion.setdefault(motion_id, []).append(row)
    motions = []
    for motion_id, rows in rows_of_motion.items():
        rows.sort(key=lambda row: int(columns["camera_index"][row]))
        for column in ("object_uid", "split"):
            if len({columns[column][row] for row in rows}) != 1:
                raise CorruptShardError(
                    f"the clips of motion {motion_id} differ", where=table.where, row=rows[0], column=column
                )
        motions.append(
            MotionRef(
                shard=number,
                motion_id=motion_id,
                object_uid=columns["object_uid"][rows[0]],
                split=columns["split"][rows[0]],
                clip_rows=tuple(rows),
                frame_counts=tuple(int(columns["n_frames"][row]) for row in rows),
            )
        )
    return motions


def _with_cameras(motion: MotionRef, cameras: Cameras, held_out_share: float) -> MotionRef:
    """Only the cameras asked for; at least one always remains for training."""
    n_cameras = len(motion.clip_rows)
    n_held_out = min(n_cameras - 1, math.ceil(held_out_share * n_cameras))
    ranges = {
        "all": slice(None),
        "train": slice(0, n_cameras - n_held_out),
        "held_out": slice(n_cameras - n_held_out, None),
    }
    kept = ranges[cameras]
    return replace(motion, clip_rows=motion.clip_rows[kept], frame_counts=motion.frame_counts[kept])


def _check_enough(
    chosen: Sequence[MotionRef], found: Sequence[Sequence[MotionRef]], config: StreamConfig
) -> None:
    places = ", ".join(config.datasets)
    if not chosen:
        counts = dict.fromkeys(("train", "val", "test"), 0)
        for motion in (motion for motions in found for motion in motions):
            counts[motion.split] += 1
        wanted = f"a motion of split '{config.split}' with cameras '{config.cameras}'"
        seen = ", ".join(f"{count} {split}" for split, count in counts.items())
        raise ModelError(
            places,
            f"none of its motions ({seen}) can be used",
            expected=wanted,
            action="Held-out cameras need motions with two or more cameras; splits are by object.",
        )
    for motion in chosen:
        if motion.n_frames < config.views[1]:
            raise ModelError(
                places,
                f"{motion.motion_id} has {motion.n_frames} frames with cameras '{config.cameras}'",
                expected=f"at least the {config.views[1]} views asked for",
                action="Lower `views` in the recipe, or in `validation`.",
            )
