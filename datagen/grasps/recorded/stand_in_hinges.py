"""A recorded motion in terms of the anatomical hinges of the hand that stands in.

A recorded joint may turn about any axis and its zero is that of another hand. Here every joint keeps
the turn about its anatomical axes; a hinge that goes beyond its range as recorded is shifted as a
whole, since that much shows how far the zeros of the two hands differ, and clipped where it still
goes beyond. Hand frame: as in `hand_body`, origin at the wrist joint.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from datagen.grasps.hand_body import HandBody, Hinge, local_rotations
from datagen.grasps.hand_parameters import HandParameters
from datagen.hands.model import HandModel, PosedHand, ShapedHand, pose_hand

__all__ = [
    "HingedMotion",
    "corrected",
    "hinge_shares",
    "hinge_turns",
    "hinged_readings",
    "motion_at",
    "palmar_pads",
    "pose_hinged",
    "skin_normals",
    "to_parameters",
    "wrist_pivot",
]

_PALMAR = 0.4  # cosine between a pad's direction and the normals of its vertices
_DECOMPOSITION_STEPS = 16
_DECOMPOSITION_STEP_RAD = 0.3
_TWIST_WEIGHT = 0.4  # of a bone's turn about itself against its direction
# Weight of (angle / 1 rad) against (wrong direction / 1 rad): decides between axes that nearly coincide
# (the thumb's spread and flexion); biases an exact answer by about a hundredth of it.
_ANGLE_WEIGHT = 0.1
_SMOOTHING_FRAMES = 2.0  # Gaussian over time: limits and near-coincident axes make angles jump
_USUAL_PERCENT = 5.0  # of the frames may lie beyond the range that decides about a shift


@dataclass(frozen=True, kw_only=True)
class HingedMotion:
    """Hinge angles in the order of `HandBody.hinges` and the pose of the wrist joint."""

    angles_rad: Float[np.ndarray, "frame hinge"]
    R_world_from_hand: Float[np.ndarray, "frame 3 3"]
    wrist_position_world: Float[np.ndarray, "frame 3"]


def hinged_readings(
    hand: ShapedHand, body: HandBody, parameters: HandParameters, max_shift_rad: float
) -> tuple[HingedMotion, HingedMotion]:
    """Two readings of a recorded motion whose joints turn like the recorded ones, within the limits.

    Hinges that go beyond their range are clipped in the first; in the second they are shifted before,
    by at most `max_shift_rad`.
    """
    full_pose = (parameters.hand_pose + hand.model.hands_mean).reshape(-1, 3)
    local = Rotation.from_rotvec(full_pose).as_matrix().reshape(-1, 15, 3, 3)
    low = np.array([hinge.low_rad for hinge in body.hinges])
    high = np.array([hinge.high_rad for hinge in body.hinges])
    angles = np.zeros((len(local), len(body.hinges)))
    for bone in range(1, 16):
        columns = [k for k, hinge in enumerate(body.hinges) if hinge.bone == bone]
        angles[:, columns] = _decomposed(
            local[:, bone - 1], _bone_direction(body, bone), [body.hinges[k] for k in columns]
        )
    least, most = np.percentile(angles, [_USUAL_PERCENT, 100.0 - _USUAL_PERCENT], axis=0)
    shift = np.maximum(low - least, 0.0) - np.maximum(most - high, 0.0)
    clipped, shifted = (
        HingedMotion(
            angles_rad=gaussian_filter1d(np.clip(read, low, high), _SMOOTHING_FRAMES, axis=0, mode="nearest"),
            R_world_from_hand=Rotation.from_rotvec(parameters.orientation_world).as_matrix(),
            wrist_position_world=parameters.translation_world + body.joints_rest[0],
        )
        for read in (angles, angles + np.clip(shift, -max_shift_rad, max_shift_rad))
    )
    return clipped, shifted


def _bone_direction(body: HandBody, bone: int) -> Float[np.ndarray, "3"]:
    """Unit, from a bone's joint to the next one, or to its pad."""
    pad = next((pad for pad in body.pads if pad.bone == bone), None)
    along = body.joints_rest[bone + 1] - body.joints_rest[bone] if pad is None else pad.position_bone
    direction: Float[np.ndarray, "3"] = along / np.linalg.norm(along)
    return direction


def _decomposed(
    local: Float[np.ndarray, "frame 3 3"], along: Float[np.ndarray, "3"], hinges: list[Hinge]
) -> Float[np.ndarray, "frame hinge"]:
    """Angles that point the bone where `local` points it, and about turn it likewise about itself.

    Damped Gauss-Newton. Limits bind only where three hinges (the thumb's base) have many solutions.
    """
    seen = np.stack([along, _TWIST_WEIGHT * hinges[-1].axis_bone])
    wanted = np.einsum("fab,sb->fsa", local, seen)
    angles = np.zeros((len(local), len(hinges)))
    for _ in range(_DECOMPOSITION_STEPS):
        turned = np.tile(np.eye(3), (len(local), 1, 1))
        axes = np.zeros((len(local), len(hinges), 3))
        for k, hinge in enumerate(hinges):
            axes[:, k] = turned @ hinge.axis_bone
            turned = turned @ Rotation.from_rotvec(angles[:, k, None] * hinge.axis_bone).as_matrix()
        now = np.einsum("fab,sb->fsa", turned, seen)
        jacobian = np.cross(axes[:, None], now[:, :, None]).transpose(0, 1, 3, 2).reshape(-1, 6, len(hinges))
        left = (wanted - now).reshape(-1, 6)
        normal = jacobian.transpose(0, 2, 1) @ jacobian + _ANGLE_WEIGHT**2 * np.eye(len(hinges))
        right = np.einsum("fck,fc->fk", jacobian, left) - _ANGLE_WEIGHT**2 * angles
        step = np.linalg.solve(normal, right[..., None])[..., 0]
        angles = angles + np.clip(step, -_DECOMPOSITION_STEP_RAD, _DECOMPOSITION_STEP_RAD)
        if len(hinges) > 2:
            angles = np.clip(angles, [h.low_rad for h in hinges], [h.high_rad for h in hinges])
    return angles


def motion_at(motion: HingedMotion, rows: Int[np.ndarray, " row"]) -> HingedMotion:
    """The frames `rows` of a motion."""
    return HingedMotion(
        angles_rad=motion.angles_rad[rows],
        R_world_from_hand=motion.R_world_from_hand[rows],
        wrist_position_world=motion.wrist_position_world[rows],
    )


def corrected(
    motion: HingedMotion,
    body: HandBody,
    correction: Float[np.ndarray, "frame parameter"],
) -> HingedMotion:
    """The motion changed by wrist shift (3, m, hand frame), wrist turn (3, rad, hand frame, about the
    knuckles' centre) and hinge angles (rad); angles stay within their limits."""
    pivot = wrist_pivot(body)
    turn = Rotation.from_rotvec(correction[:, 3:6]).as_matrix()
    moved = pivot + correction[:, :3] - turn @ pivot
    low = np.array([hinge.low_rad for hinge in body.hinges])
    high = np.array([hinge.high_rad for hinge in body.hinges])
    return HingedMotion(
        angles_rad=np.clip(motion.angles_rad + correction[:, 6:], low, high),
        R_world_from_hand=motion.R_world_from_hand @ turn,
        wrist_position_world=motion.wrist_position_world
        + np.einsum("fab,fb->fa", motion.R_world_from_hand, moved),
    )


def wrist_pivot(body: HandBody) -> Float[np.ndarray, "3"]:
    """Centre of the knuckles, hand frame: turns about it leave the fingers nearly in place."""
    pivot: Float[np.ndarray, "3"] = body.joints_rest[[1, 4, 7, 10]].mean(0) - body.joints_rest[0]
    return pivot


def to_parameters(hand: ShapedHand, body: HandBody, motion: HingedMotion) -> HandParameters:
    """As `pose_hand` takes it, finger angles as offsets from the mean pose (flat_hand_mean false)."""
    local = local_rotations(body, motion.angles_rad)[:, 1:]
    pose = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(len(local), 45)
    return HandParameters(
        orientation_world=Rotation.from_matrix(motion.R_world_from_hand).as_rotvec(),
        hand_pose=pose - hand.model.hands_mean,
        translation_world=motion.wrist_position_world - body.joints_rest[0],
    )


def pose_hinged(hand: ShapedHand, body: HandBody, motion: HingedMotion) -> PosedHand:
    """The skinned hand in every frame of the motion."""
    parameters = to_parameters(hand, body, motion)
    return pose_hand(
        hand,
        orientation_world=parameters.orientation_world,
        hand_pose=parameters.hand_pose,
        translation_world=parameters.translation_world,
        flat_hand_mean=False,
    )


def hinge_turns(
    body: HandBody, motion: HingedMotion, posed: PosedHand
) -> tuple[Float[np.ndarray, "frame hinge 3"], Float[np.ndarray, "frame hinge 3"]]:
    """World axis (unit) and origin (m) of every hinge: where a little more of its angle turns what follows."""
    axes = np.zeros((len(motion.angles_rad), len(body.hinges), 3))
    origins = posed.T_world_from_joint[:, [hinge.bone for hinge in body.hinges]][..., :3, 3]
    for bone in range(1, 16):
        behind = posed.T_world_from_joint[:, bone, :3, :3]  # behind all hinges of this bone
        for k in reversed([k for k, hinge in enumerate(body.hinges) if hinge.bone == bone]):
            axis = body.hinges[k].axis_bone
            axes[:, k] = behind @ axis
            behind = behind @ Rotation.from_rotvec(-motion.angles_rad[:, k, None] * axis).as_matrix()
    return axes, origins


def palmar_pads(hand: ShapedHand, body: HandBody) -> tuple[Int[np.ndarray, " _"], ...]:
    """Palmar vertices of each digit's two outer bones."""
    bone_of = hand.model.weights.argmax(axis=1)
    outward = skin_normals(hand)
    return tuple(
        np.flatnonzero(np.isin(bone_of, (pad.bone - 1, pad.bone)) & (outward @ pad.normal_bone > _PALMAR))
        for pad in body.pads
    )


def hinge_shares(model: HandModel, body: HandBody) -> Float[np.ndarray, "vert hinge"]:
    """Skin weight of a hinge's bone and of the bones beyond it."""
    columns = []
    for hinge in body.hinges:
        last = next(pad.bone for pad in body.pads if pad.digit == hinge.digit)
        columns.append(model.weights[:, hinge.bone : last + 1].sum(axis=1))
    return np.stack(columns, axis=1)


def skin_normals(hand: ShapedHand) -> Float[np.ndarray, "vert 3"]:
    """Unit outward normals at rest."""
    return np.asarray(trimesh.Trimesh(hand.verts_rest, hand.model.faces, process=False).vertex_normals)
