"""Metrics of a simulated motion, measured on the skinned hand and the object's own mesh."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from datagen.grasps.config import GraspConfig
from datagen.grasps.contact import digit_distances, signed_distances
from datagen.grasps.hand_body import HandBody, local_rotations
from datagen.grasps.hand_parameters import HandParameters, hand_center
from datagen.grasps.object_movement import Movement
from datagen.grasps.object_surface import ObjectSurface, verts_in_object
from datagen.grasps.sequence import GraspQuality, TableEdge
from datagen.grasps.synthesis.simulation import Failure, MotionTrace
from datagen.hands.model import HandModel, PosedHand

__all__ = [
    "below_table",
    "hand_parameters",
    "measure_quality",
    "measured_instants",
    "penetration_depths",
    "rejection",
]

CONTACT_INSTANTS = 5  # at which the digits' distances are measured
INSTANTS = 24  # of the carried motion; the approach gets a few more
CONTACT_N = 0.05
SUNK_M = 0.002


def measured_instants(grasp_frame: int, frames: int) -> Int[np.ndarray, " instant"]:
    """Frames at which penetration is measured: the whole motion, most of them while carried."""
    before = np.linspace(0, grasp_frame, 7)[1:-1]
    carried = np.linspace(grasp_frame, frames - 1, INSTANTS)
    return np.unique(np.concatenate([before, carried]).round().astype(int))


def hand_parameters(body: HandBody, trace: MotionTrace) -> HandParameters:
    """Hinge angles and wrist poses as MANO axis-angles and translation; exact."""
    local = local_rotations(body, trace.angles_rad)[:, 1:]
    return HandParameters(
        orientation_world=Rotation.from_matrix(trace.R_world_from_hand).as_rotvec(),
        hand_pose=Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(len(local), 45),
        translation_world=trace.wrist_position_world - body.joints_rest[0],
    )


def penetration_depths(
    surface: ObjectSurface,
    verts_world: Float[np.ndarray, "instant vert 3"],
    T_world_from_obj: Float[np.ndarray, "instant 4 4"],
) -> Float[np.ndarray, "instant vert"]:
    """Depth of every hand vertex inside the object (m)."""
    verts_obj = verts_in_object(verts_world, T_world_from_obj)
    return surface.depth(verts_obj.reshape(-1, 3)).reshape(verts_world.shape[:2])


def measure_quality(
    model: HandModel,
    posed: PosedHand,
    surface: ObjectSurface,
    trace: MotionTrace,
    rows: Int[np.ndarray, " instant"],
    com_obj: Float[np.ndarray, "3"],
    attempts: int,
) -> GraspQuality:
    """Quality of a motion whose skinned hand is given at the frames `rows` (the last one included)."""
    depth = penetration_depths(surface, posed.verts_world, trace.T_world_from_obj[rows])
    com_world = trace.T_world_from_obj[:, :3, :3] @ com_obj + trace.T_world_from_obj[:, :3, 3]
    com_hand = np.einsum("tji,tj->ti", trace.R_world_from_hand, com_world - trace.wrist_position_world)
    lifting = com_hand[trace.grasp_frame : trace.lifted_frame] - com_hand[trace.grasp_frame]
    turning = com_hand[trace.lifted_frame :] - com_hand[trace.lifted_frame]
    end = trace.T_world_from_obj[-1, :3, 3]
    carried = np.flatnonzero(rows >= trace.grasp_frame)
    looked = carried[np.linspace(0, len(carried) - 1, CONTACT_INSTANTS).round().astype(int)]
    distances = signed_distances(surface, posed.verts_world[looked], trace.T_world_from_obj[rows[looked]])
    return GraspQuality(
        rise_m=float(end[2] - trace.T_world_from_obj[0, 2, 3]),
        center_distance_m=float(np.linalg.norm(hand_center(posed)[-1] - end)),
        max_penetration_m=float(depth.max()),
        digits_in_contact=int((trace.force_n[-1, :5] > CONTACT_N).sum()),
        slip_lift_m=float(np.linalg.norm(lifting, axis=1).max()),
        slip_manipulation_m=float(np.linalg.norm(turning, axis=1).max()),
        contact_force_n=float(trace.force_n[-1].sum()),
        attempts=attempts,
        digit_distance_m=np.median(digit_distances(model, distances), axis=0),
    )


def rejection(
    quality: GraspQuality, trace: MotionTrace, movement: Movement, config: GraspConfig
) -> Failure | None:
    """The first rule a motion breaks, or None: GraspXL's two, then contact, depth, slip, movement."""
    rules = (
        (quality.rise_m > config.min_rise_m, Failure.NOT_RISEN),
        (quality.center_distance_m < config.max_center_distance_m, Failure.OFF_CENTER),
        (quality.digits_in_contact >= config.min_digits, Failure.FEW_DIGITS),
        (trace.force_n[-1, 0] > CONTACT_N, Failure.FEW_DIGITS),  # the thumb opposes
        (quality.max_penetration_m <= config.max_penetration_m, Failure.PENETRATION),
        (quality.slip_lift_m <= config.max_slip_m, Failure.SLIP),
        (quality.slip_manipulation_m <= config.max_slip_m, Failure.SLIP),
        (movement.rotation_range_rad >= config.min_movement_rad, Failure.NO_MOVEMENT),
    )
    return next((failure for passed, failure in rules if not passed), None)


def below_table(
    posed: PosedHand, edge: TableEdge | None, body: HandBody, config: GraspConfig
) -> Bool[np.ndarray, " instant"]:
    """Instants at which skin or forearm sinks into the table by more than 2 mm."""
    wrist = posed.T_world_from_joint[:, 0]
    axis = wrist[:, :3, :3] @ body.distal
    back = np.linspace(2.0 * config.forearm_radius_m, config.forearm_length_m - config.forearm_radius_m, 4)
    forearm = wrist[:, None, :3, 3] - back[:, None] * axis[:, None]
    forearm = forearm - [0.0, 0.0, config.forearm_radius_m]
    points = np.concatenate([posed.verts_world, forearm], 1)
    sunk = points[..., 2] < -SUNK_M
    if edge is not None:
        beyond = (points[..., :2] - edge.point_xy_m) @ np.array(edge.outward_xy)
        sunk &= beyond < -SUNK_M
    return sunk.any(1)
