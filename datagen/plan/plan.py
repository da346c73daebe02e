"""What to render: motion -> object, recorded sequence, hand and shard, decided before anything is rendered.

A motion is one grasp sequence seen by all cameras; a clip is one motion seen by one
camera. The plan is a pure function of the configuration, so that any shard, on any
machine, in any order, is the same.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from datagen.objects.asset.mirror import mirrored_uid
from datagen.sampling.streams import Stream, stream_rng
from shards.settings import Range
from shards.splits import SplitRule, split_of_object
from shards.storage.whole_file import write_whole

__all__ = [
    "PLAN_FILE",
    "SELECTION_FILE",
    "Candidate",
    "MotionPlan",
    "Plan",
    "PlanConfig",
    "PlanError",
    "make_plan",
    "read_plan",
    "write_plan",
]

PLAN_FILE = "plan.parquet"
SELECTION_FILE = "selection.parquet"  # beside it: every decision that led to it
PLAN_STREAM = 0x504C414E  # the plan's own stream of the dataset seed


class PlanError(ValueError):
    """The plan is missing, unreadable, or does not contain what was asked for."""


@dataclass(frozen=True, kw_only=True)
class PlanConfig:
    """How many motions there are and how they fall into shards."""

    motions: Annotated[int, Range(1, 10_000_000)]
    motions_per_shard: Annotated[int, Range(1, 100_000)]


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """What a motion may be made of: an object, and a recorded sequence of it where motions are recorded."""

    object_uid: str
    sequence_id: str  # empty: the motion is simulated
    licence: str  # as the selection found and allowed it
    appearance: str  # original or generated


@dataclass(frozen=True, kw_only=True)
class MotionPlan:
    """One row of plan.parquet."""

    motion_index: int
    motion_id: str
    shard: int
    object_uid: str  # as drawn: of the mirror image where a recorded motion is mirrored
    sequence_id: str  # of the recorded motion; empty: simulated
    hand_side: str  # right or left
    licence: str  # of the object, as it was allowed; the worker refuses another one
    appearance: str  # original or generated, likewise
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
    candidates: Sequence[Candidate],
    left_probability: float,
    split_rule: SplitRule,
    n_cameras: int,
    n_frames: int,
    image_size: tuple[int, int],
    samples: int,
) -> Plan:
    """Deal the objects out in shuffled rounds: every object once before any object twice.

    Of an object with several recorded sequences each round takes another one; when all sequences
    are used up they come again. A left hand is the mirror image of a right one; a recorded motion
    is mirrored with its object, a simulated one is simulated with the mirrored object instead.
    """
    if not candidates:
        raise PlanError(
            "there is nothing to plan: expected at least one object that the selection keeps; "
            "see what it removes: datagen select"
        )
    cost = n_cameras * n_frames * image_size[0] * image_size[1] * samples / 1e6
    motions = []
    for index, candidate in enumerate(_dealt(candidates, config.motions, dataset_seed)):
        is_left = stream_rng(dataset_seed, index, Stream.HAND_SIDE).uniform() < left_probability
        uid = candidate.object_uid
        if is_left and candidate.sequence_id:
            uid = mirrored_uid(uid)
        motions.append(
            MotionPlan(
                motion_index=index,
                motion_id=f"motion-{index:06d}",
                shard=index // config.motions_per_shard,
                object_uid=uid,
                sequence_id=candidate.sequence_id,
                hand_side="left" if is_left else "right",
                licence=candidate.licence,
                appearance=candidate.appearance,
                split=split_of_object(uid, split_rule),
                n_cameras=n_cameras,
                n_frames=n_frames,
                cost_megapixel_samples=cost,
            )
        )
    return Plan(motions=tuple(motions))


def _dealt(candidates: Sequence[Candidate], n_motions: int, dataset_seed: int) -> list[Candidate]:
    """`n_motions` candidates in dealing order, whatever the order they came in."""
    of_object: dict[str, list[Candidate]] = {}
    for candidate in sorted(candidates, key=lambda c: (c.object_uid, c.sequence_id)):
        of_object.setdefault(candidate.object_uid, []).append(candidate)
    shuffle = np.random.default_rng(np.random.SeedSequence([dataset_seed, PLAN_STREAM, 1]))
    for group in of_object.values():
        shuffle.shuffle(group)  # type: ignore[arg-type]
    rng = np.random.default_rng(np.random.SeedSequence([dataset_seed, PLAN_STREAM]))
    deepest = max(len(group) for group in of_object.values())
    dealt: list[Candidate] = []
    turn = 0
    while len(dealt) < n_motions:
        this_round = [group[turn] for group in of_object.values() if len(group) > turn]
        dealt += [this_round[i] for i in rng.permutation(len(this_round))]
        turn = (turn + 1) % deepest
    return dealt[:n_motions]


def write_plan(plan: Plan, path: Path) -> None:
    """Write plan.parquet in one step: a reader sees the old file, the new one, or none."""
    columns = {field.name: [getattr(m, field.name) for m in plan.motions] for field in fields(MotionPlan)}
    path.parent.mkdir(parents=True, exist_ok=True)
    with write_whole(path, durable=True) as partial:
        pq.write_table(pa.table(columns), partial, compression="zstd", write_page_checksum=True)


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
