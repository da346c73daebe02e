"""synthesise_grasp: simulate attempts until one motion is worth keeping."""

import time
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from datagen.grasps.config import GraspConfig
from datagen.grasps.hand_body import build_hand_body, local_rotations
from datagen.grasps.movement import Movement, measure_movement
from datagen.grasps.preshapes import build_preshapes
from datagen.grasps.proposals import propose, sample_surface
from datagen.grasps.quality import ObjectSurface, below_table, measure_quality, rejection
from datagen.grasps.sequence import GraspQuality, GraspSequence
from datagen.grasps.simulation import FRAME_RATE_HZ, Failure, MotionTrace, simulate
from datagen.grasps.starts import Start, resting_poses, sample_start
from datagen.grasps.world import GraspWorld, HandBody
from datagen.hands.model import ShapedHand
from datagen.objects.asset import ObjectAsset

__all__ = ["GraspAttemptReport", "synthesise_grasp"]


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
    world = GraspWorld(body, obj, config)
    surface, samples = ObjectSurface(obj), sample_surface(obj, rng)
    poses = resting_poses(obj, world.com_obj)
    failures: list[Failure] = []
    kept: tuple[GraspSequence, Movement] | None = None
    while kept is None and len(failures) < config.max_attempts:
        start = sample_start(poses, config, rng)
        proposals = propose(world, samples, library, start, config, rng)
        if not proposals:
            failures.append(Failure.NO_PLACEMENT)
        for proposal in proposals[: config.simulated_per_start]:
            trace = simulate(world, start, proposal, config, rng)
            if isinstance(trace, MotionTrace):
                judged = _judge(hand, body, obj, surface, world, start, trace, len(failures) + 1, config)
                if not isinstance(judged, Failure):
                    kept = judged
                    break
                trace = judged
            failures.append(trace)
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
    hand: ShapedHand,
    body: HandBody,
    obj: ObjectAsset,
    surface: ObjectSurface,
    world: GraspWorld,
    start: Start,
    trace: MotionTrace,
    attempt: int,
    config: GraspConfig,
) -> tuple[GraspSequence, Movement] | Failure:
    sequence = _to_sequence(hand, body, obj, start, trace)
    quality, posed = measure_quality(hand, surface, sequence, trace, world.com_obj)
    movement = measure_movement(trace.T_world_from_obj[trace.grasp_frame :])
    reason = rejection(quality, sequence, movement.rotation_range_rad, config)
    if reason is not None:
        return reason
    if below_table(posed, sequence, body, config).any():
        return Failure.BELOW_TABLE
    return replace(sequence, quality=replace(quality, attempts=attempt)), movement


def _to_sequence(
    hand: ShapedHand, body: HandBody, obj: ObjectAsset, start: Start, trace: MotionTrace
) -> GraspSequence:
    local = local_rotations(body, trace.angles_rad)[:, 1:]
    frames = len(local)
    return GraspSequence(
        sequence_id=f"simulated-{obj.uid}",
        object_uid=obj.uid,
        hand_model=hand.model.name,
        side=hand.model.side,
        fps=FRAME_RATE_HZ,
        flat_hand_mean=True,
        betas=np.asarray(hand.betas, dtype=float),
        hand_orientation_world=Rotation.from_matrix(trace.R_world_from_hand).as_rotvec(),
        hand_pose=Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(frames, 45),
        hand_translation_world=trace.wrist_position_world - body.joints_rest[0],
        T_world_from_obj=trace.T_world_from_obj,
        contact_force_n=trace.force_n[:, :5],
        grasp_frame=trace.grasp_frame,
        quality=GraspQuality(
            rise_m=0.0,
            center_distance_m=0.0,
            max_penetration_m=0.0,
            digits_in_contact=0,
            slip_lift_m=0.0,
            slip_manipulation_m=0.0,
            contact_force_n=0.0,
            attempts=0,
        ),
        start=start.kind,
        table_edge=start.table_edge,
        first_drawn_frame=trace.grasp_frame if start.kind == "held" else 0,
    )
