"""What to render: motion -> object and shard, decided before anything is rendered.

A motion is one grasp sequence seen by all cameras; a clip is one motion seen by one
camera. The plan is a pure function of the configuration, so that any shard, on any
machine, in any order, is the same.
"""

import os
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shards.splits import SplitRule, split_of_object

__all__ = [
    "PLAN_FILE",
    "MotionPlan",
    "Plan",
    "PlanConfig",
    "PlanError",
    "make_plan",
    "read_plan",
    "write_plan",
]

PLAN_FILE = "plan.parquet"
PLAN_STREAM = 0x504C414E  # the plan's own stream of the dataset seed


class PlanError(ValueError):
    """The plan is missing, unreadable, or does not contain what was asked for."""


@dataclass(frozen=True, kw_only=True)
class PlanConfig:
    """How many motions there are and how they fall into shards."""

    motions: int
    motions_per_shard: int


@dataclass(frozen=True, kw_only=True)
class MotionPlan:
    """One row of plan.parquet."""

    motion_index: int
    motion_id: str
    shard: int
    object_uid: str
    split: str
    n_cameras: int
    n_frames: int
    cost_megapixel_samples: float  # pixels x samples of all frames, in millions


@dataclass(frozen=True, kw_only=True)
class Plan:
    """All motions in order of `motion_index`."""

    motions: tuple[MotionPlan, ...]

    @property
    def n_shards(self) -> int:
        return 1 + max(motion.shard for motion in self.motions)

    @property
    def n_clips(self) -> int:
        return sum(motion.n_cameras for motion in self.motions)

    def shard(self, shard: int) -> tuple[MotionPlan, ...]:
        """The motions of one shard; PlanError when the shard is not in the plan."""
        if not 0 <= shard < self.n_shards:
            raise PlanError(
                f"shard {shard} is outside the plan: expected 0..{self.n_shards - 1} "
                f"({len(self.motions)} motions in {self.n_shards} shards); "
                "choose a shard in that range or raise plan.motions in the configuration"
            )
        return tuple(motion for motion in self.motions if motion.shard == shard)


def make_plan(
    config: PlanConfig,
    *,
    dataset_seed: int,
    object_uids: Sequence[str],
    split_rule: SplitRule,
    n_cameras: int,
    n_frames: int,
    image_size: tuple[int, int],
    samples: int,
) -> Plan:
    """Deal the objects out in shuffled rounds: every object once before any object twice."""
    if not object_uids:
        raise PlanError(
            "the object library is empty: expected at least one object; check objects.* in the config"
        )
    rng = np.random.default_rng(np.random.SeedSequence([dataset_seed, PLAN_STREAM]))
    uids = sorted(object_uids)
    rounds = -(-config.motions // len(uids))
    order = np.concatenate([rng.permutation(len(uids)) for _ in range(rounds)])[: config.motions]
    cost = n_cameras * n_frames * image_size[0] * image_size[1] * samples / 1e6
    motions = tuple(
        MotionPlan(
            motion_index=index,
            motion_id=f"motion-{index:06d}",
            shard=index // config.motions_per_shard,
            object_uid=uids[choice],
            split=split_of_object(uids[choice], split_rule),
            n_cameras=n_cameras,
            n_frames=n_frames,
            cost_megapixel_samples=cost,
        )
        for index, choice in enumerate(order)
    )
    return Plan(motions=motions)


def write_plan(plan: Plan, path: Path) -> None:
    """Write plan.parquet in one step: a reader sees the old file, the new one, or none."""
    columns = {field.name: [getattr(m, field.name) for m in plan.motions] for field in fields(MotionPlan)}
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
        pq.write_table(pa.table(columns), file, compression="zstd", write_page_checksum=True)
        file.flush()
        os.fsync(file.fileno())
    os.replace(file.name, path)


def read_plan(path: Path) -> Plan:
    """The plan that `write_plan` wrote; PlanError when there is none or it is damaged."""
    if not path.is_file():
        raise PlanError(
            f"{path}: no plan here; make one with: datagen plan --config CONFIG --out {path.parent}"
        )
    try:
        table = pq.read_table(path, page_checksum_verification=True)
        motions = tuple(MotionPlan(**row) for row in table.to_pylist())
    except (pa.ArrowException, OSError, TypeError) as error:
        raise PlanError(
            f"{path}: not a readable plan ({error}); delete it and run datagen plan again"
        ) from error
    return Plan(motions=motions)


def same_plan(a: Plan, b: Plan) -> bool:
    """Whether two plans say the same, field by field."""
    return [asdict(m) for m in a.motions] == [asdict(m) for m in b.motions]
