"""synthesise_grasp: simulate attempts until one motion is worth keeping."""

import time
from collections import Counter
from dataclasses import dataclass

import numpy as np

from datagen.grasps.config import GraspConfig
from datagen.grasps.hand_body import HandBody, build_hand_body
from datagen.grasps.object_movement import Movement, measure_movement
from datagen.grasps.object_surface import ObjectSurface
from datagen.grasps.sequence import GraspSequence
from datagen.grasps.synthesis.physics_world import GraspWorld
from datagen.grasps.synthesis.preshapes import build_preshapes
from datagen.grasps.synthesis.proposals import propose, sample_surface
from datagen.grasps.synthesis.quality import (
    below_table,
    hand_parameters,
    measure_quality,
    measured_instants,
    rejection,
)
from datagen.grasps.synthesis.simulation import FRAME_RATE_HZ, Failure, MotionTrace, simulate
from datagen.grasps.synthesis.start_poses import START_KINDS, Start, resting_poses, sample_start
from datagen.hands.model import ShapedHand, pose_hand
from datagen.objects.asset.object_asset import ObjectAsset

__all__ = ["GraspAttemptReport", "synthesise_grasp"]

# A start that failed is tried less often in what remains of the attempts.
TRUST_WITHOUT_PLACEMENT = 0.15
TRUST_AFTER_FAILURE = 0.7


@dataclass(frozen=True, kw_only=True)
class GraspAttemptReport:
    """What came of one synthesis: the kept motion, or nothing and the reasons."""

    object_uid: str
    sequence: GraspSequence | None  # None: every attempt failed
    movement: Movement | None
    attempts: int
    failures: tuple[Failure, ...]  # one per failed attempt, in order
    cpu_seconds: float

    def failure_counts(self) -> dict[str, int]:
        """Failed attempts per reason, most frequent first."""
        return {reason.value: count for reason, count in Counter(self.failures).most_common()}


@dataclass(frozen=True, kw_only=True)
class _Bench:
    """What stays the same over all attempts."""

    hand: ShapedHand
    body: HandBody
    obj: ObjectAsset
    world: GraspWorld
    surface: ObjectSurface
    config: GraspConfig


def synthesise_grasp(
    hand: ShapedHand, obj: ObjectAsset, config: GraspConfig, rng: np.random.Generator
) -> GraspAttemptReport:
    """One motion of `hand` with `obj`. World: table top z = 0, Z up, object near the origin.

    The same arguments and generator state give the same bits. An attempt is one simulated
    placement, or one start for which no clear placement was found.
    """
    began = time.process_time()
    body = build_hand_body(hand)
    library = build_preshapes(body)
    bench = _Bench(
        hand=hand,
        body=body,
        obj=obj,
        world=GraspWorld(body, obj, config),
        surface=ObjectSurface(obj),
        config=config,
    )
    samples = sample_surface(obj, rng)
    poses = resting_poses(obj, bench.world.com_obj)
    trust = np.ones((len(poses.weight), len(START_KINDS)))
    failures: list[Failure] = []
    kept: tuple[GraspSequence, Movement] | None = None
    while kept is None and len(failures) < config.max_attempts:
        start = sample_start(poses, trust, config, rng)
        proposals = propose(bench.world, samples, library, start, config, rng)
        if not proposals:
            failures.append(Failure.NO_PLACEMENT)
            trust[start.option] *= TRUST_WITHOUT_PLACEMENT
        for proposal in proposals[: config.simulated_per_start]:
            trace = simulate(bench.world, start, proposal, config, rng)
            outcome = trace if isinstance(trace, Failure) else _judge(bench, start, trace, len(failures) + 1)
            if not isinstance(outcome, Failure):
                kept = outcome
                break
            failures.append(outcome)
            trust[start.option] *= TRUST_AFTER_FAILURE
            if len(failures) == config.max_attempts:
                break
    return GraspAttemptReport(
        object_uid=obj.uid,
        sequence=kept[0] if kept else None,
        movement=kept[1] if kept else None,
        attempts=len(failures) + (kept is not None),
        failures=tuple(failures),
        cpu_seconds=time.process_time() - began,
    )


def _judge(
    bench: _Bench, start: Start, trace: MotionTrace, attempt: int
) -> tuple[GraspSequence, Movement] | Failure:
    """The sequence of a simulated motion, or the rule it breaks."""
    parameters = hand_parameters(bench.body, trace)
    rows = measured_instants(trace.grasp_frame, len(trace.angles_rad))
    posed = pose_hand(
        bench.hand,
        orientation_world=parameters.orientation_world[rows],
        hand_pose=parameters.hand_pose[rows],
        translation_world=parameters.translation_world[rows],
        flat_hand_mean=True,
    )
    quality = measure_quality(
        bench.hand.model, posed, bench.surface, trace, rows, bench.world.com_obj, attempt
    )
    movement = measure_movement(trace.T_world_from_obj[trace.grasp_frame :])
    reason = rejection(quality, trace, movement, bench.config)
    if reason is not None:
        return reason
    if below_table(posed, start.table_edge, bench.body, bench.config).any():
        return Failure.BELOW_TABLE
    sequence = GraspSequence(
        sequence_id=f"simulated-{bench.obj.uid}",
        object_uid=bench.obj.uid,
        hand_model=bench.hand.model.name,
        side=bench.hand.model.side,
        fps=FRAME_RATE_HZ,
        flat_hand_mean=True,
        betas=np.asarray(bench.hand.betas, dtype=float),
        hand_orientation_world=parameters.orientation_world,
        hand_pose=parameters.hand_pose,
        hand_translation_world=parameters.translation_world,
        T_world_from_obj=trace.T_world_from_obj,
        contact_force_n=trace.force_n[:, :5],
        grasp_frame=trace.grasp_frame,
        quality=quality,
        start=start.kind,
        table_edge=start.table_edge,
        first_drawn_frame=trace.grasp_frame if start.kind == "held" else 0,
    )
    return sequence, movement
