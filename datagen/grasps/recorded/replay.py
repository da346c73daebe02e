"""A recorded motion replayed by a hand of ours: exactly by MANO, approximately by a stand-in.

GraspXL was recorded with MANO and betas 0. Another hand takes the wrist's path and the finger
angles as offsets from its own mean pose, and is then fitted to the object (`stand_in`); the
sequence says so in `stands_in_for`, and its contacts are measured, not assumed.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from datagen.grasps.contact import digit_distances, digits_touching, signed_distances
from datagen.grasps.hand_parameters import HandParameters, hand_center
from datagen.grasps.object_surface import ObjectSurface
from datagen.grasps.recorded.graspxl import GRASPXL_FPS, LICENCE, RecordedMotion
from datagen.grasps.recorded.resample import resample_sequence
from datagen.grasps.recorded.stand_in import REFERENCE_STAND_IN, fitted_stand_in
from datagen.grasps.sequence import GraspQuality, GraspSequence
from datagen.hands.model import PosedHand, ShapedHand, pose_hand
from datagen.objects.asset.object_asset import ObjectAsset
from shards.geometry import invert_transform
from shards.settings import Range

__all__ = ["RECORDED_HAND", "ReplayConfig", "ReplayError", "replay"]

RECORDED_HAND = "mano"
# MANO's rest wrist joint at betas 0, metres: GraspXL's own constant (FORMATS 2.2).
_RECORDED_WRIST_REST = np.array([0.09566994, 0.00638343, 0.0061863])
_STEP = 5  # frames between the instants at which contact is measured
_NAN = float("nan")


class ReplayError(ValueError):
    """A recorded motion is not worth drawing; the message says why, with metrics."""


@dataclass(frozen=True, kw_only=True)
class ReplayConfig:
    """How recorded motions are replayed."""

    time_scale: Annotated[float, Range(0.01, 100)]  # 1: as recorded; 2: the motion takes twice as long
    # the hand carries the object once it stays this close to its place in the hand ...
    carried_m: Annotated[float, Range(0, 1)]
    carried_rad: Annotated[float, Range(0, 3.15)]  # ... and this close to its orientation
    min_digits: Annotated[int, Range(0, 5)]  # that touch the object at the end
    max_penetration_m: Annotated[float, Range(0, 1)]  # hand vertices into the object while it is carried

    def __post_init__(self) -> None:
        if not self.time_scale > 0.0:
            raise ValueError(f"time_scale is {self.time_scale}: expected a positive factor")


def replay(
    recorded: RecordedMotion, hand: ShapedHand, asset: ObjectAsset, config: ReplayConfig
) -> GraspSequence:
    """The recorded motion with `hand` (right, betas 0). World: table top z = 0.

    The object's mesh file and the motion's name one frame; `asset.T_obj_from_file` leads from it to
    the object frame. Raises ReplayError when hand and object never come together.
    """
    _require_neutral_right_hand(hand)
    surface = ObjectSurface(asset)
    T_world_from_obj = recorded.T_world_from_file @ invert_transform(_rigid(asset))
    exact = hand.model.name == RECORDED_HAND
    parameters = HandParameters(
        orientation_world=recorded.hand_orientation_world,
        hand_pose=recorded.hand_pose,
        translation_world=recorded.hand_translation_world,
    )
    wrist_rest = hand.joints_rest[0] if exact else _RECORDED_WRIST_REST
    T_hand_from_obj = _object_in_hand(parameters, wrist_rest, T_world_from_obj)
    carried = _carried_from(T_hand_from_obj, config)
    if not exact:
        moved = parameters.translation_world + wrist_rest - hand.joints_rest[0]
        parameters = fitted_stand_in(
            hand,
            replace(parameters, translation_world=moved),
            T_world_from_obj,
            surface,
            carried_from=carried,
            config=REFERENCE_STAND_IN,
        )
    rows = np.unique(np.append(np.arange(carried, len(T_world_from_obj), _STEP), len(T_world_from_obj) - 1))
    posed = _posed(hand, parameters, rows)
    distances = signed_distances(surface, posed.verts_world, T_world_from_obj[rows])
    digits = digit_distances(hand.model, distances)
    touching = digits_touching(digits)
    if touching[-1] < config.min_digits:
        raise ReplayError(
            f"{recorded.sequence_id}: {touching[-1]} digits touch {asset.uid} at the end, expected "
            f"{config.min_digits} (thumb to pinky, mm: {_millimetres(digits[-1])})"
        )
    grasp_frame = int(rows[_first_kept(touching >= config.min_digits)])
    depth = float(max(-distances[rows >= grasp_frame].min(), 0.0))
    if depth > config.max_penetration_m:
        raise ReplayError(
            f"{recorded.sequence_id}: the hand sinks {1e3 * depth:.1f} mm into {asset.uid}, allowed "
            f"{1e3 * config.max_penetration_m:g} mm"
        )
    in_hand = _object_in_hand(parameters, hand.joints_rest[0], T_world_from_obj)[grasp_frame:, :3, 3]
    quality = GraspQuality(
        rise_m=float(T_world_from_obj[-1, 2, 3] - T_world_from_obj[0, 2, 3]),
        center_distance_m=float(np.linalg.norm(hand_center(posed)[-1] - T_world_from_obj[-1, :3, 3])),
        max_penetration_m=depth,
        digits_in_contact=int(touching[-1]),
        slip_lift_m=float(np.linalg.norm(in_hand - in_hand[0], axis=1).max()),
        slip_manipulation_m=_NAN,
        contact_force_n=_NAN,
        attempts=0,
        digit_distance_m=np.median(digits[rows >= grasp_frame], axis=0),
    )
    sequence = _sequence(recorded, hand, asset, parameters, T_world_from_obj, grasp_frame, quality)
    slowed = replace(sequence, fps=GRASPXL_FPS / config.time_scale)
    return resample_sequence(slowed, GRASPXL_FPS) if config.time_scale != 1.0 else slowed


def _sequence(
    recorded: RecordedMotion,
    hand: ShapedHand,
    asset: ObjectAsset,
    parameters: HandParameters,
    T_world_from_obj: Float[np.ndarray, "frame 4 4"],
    grasp_frame: int,
    quality: GraspQuality,
) -> GraspSequence:
    return GraspSequence(
        sequence_id=recorded.sequence_id,
        object_uid=asset.uid,
        hand_model=hand.model.name,
        stands_in_for="" if hand.model.name == RECORDED_HAND else RECORDED_HAND,
        side="right",
        fps=GRASPXL_FPS,
        flat_hand_mean=False,
        betas=np.asarray(hand.betas, dtype=float),
        hand_orientation_world=parameters.orientation_world,
        hand_pose=parameters.hand_pose,
        hand_translation_world=parameters.translation_world,
        T_world_from_obj=T_world_from_obj,
        contact_force_n=np.full((len(T_world_from_obj), 5), _NAN),
        grasp_frame=grasp_frame,
        quality=quality,
        source="graspxl",
        licence=LICENCE,
    )


def _require_neutral_right_hand(hand: ShapedHand) -> None:
    if hand.model.side != "right" or np.any(hand.betas != 0.0):
        raise ValueError(
            f"recorded motions need a right hand with betas 0, found {hand.model.side} with "
            f"{np.round(hand.betas, 3).tolist()}; mirror the motion afterwards for a left one"
        )


def _rigid(asset: ObjectAsset) -> Float[np.ndarray, "4 4"]:
    R = asset.T_obj_from_file[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-6):
        raise ValueError(
            f"{asset.uid}: T_obj_from_file scales by {np.cbrt(np.linalg.det(R)):.4f}; a recorded motion "
            "needs the object at the size it was recorded with"
        )
    return asset.T_obj_from_file


def _object_in_hand(
    parameters: HandParameters,
    wrist_rest: Float[np.ndarray, "3"],
    T_world_from_obj: Float[np.ndarray, "frame 4 4"],
) -> Float[np.ndarray, "frame 4 4"]:
    """Object pose seen from a wrist that rests at `wrist_rest`."""
    T_world_from_hand = np.tile(np.eye(4), (len(T_world_from_obj), 1, 1))
    T_world_from_hand[:, :3, :3] = Rotation.from_rotvec(parameters.orientation_world).as_matrix()
    T_world_from_hand[:, :3, 3] = parameters.translation_world + wrist_rest
    return invert_transform(T_world_from_hand) @ T_world_from_obj


def _carried_from(T_hand_from_obj: Float[np.ndarray, "frame 4 4"], config: ReplayConfig) -> int:
    """First frame from which on the object keeps its final place in the hand."""
    last = T_hand_from_obj[-1]
    shift = np.linalg.norm(T_hand_from_obj[:, :3, 3] - last[:3, 3], axis=1)
    turn = Rotation.from_matrix(T_hand_from_obj[:, :3, :3] @ last[:3, :3].T).magnitude()
    return _first_kept((shift <= config.carried_m) & (turn <= config.carried_rad))


def _first_kept(holds: np.ndarray) -> int:
    """First index from which on a condition holds to the end (where it holds)."""
    broken = np.flatnonzero(~holds)
    return int(broken[-1]) + 1 if len(broken) else 0


def _posed(hand: ShapedHand, parameters: HandParameters, rows: np.ndarray) -> PosedHand:
    return pose_hand(
        hand,
        orientation_world=parameters.orientation_world[rows],
        hand_pose=parameters.hand_pose[rows],
        translation_world=parameters.translation_world[rows],
        flat_hand_mean=False,
    )


def _millimetres(distances_m: Float[np.ndarray, "5"]) -> str:
    return ", ".join(f"{1e3 * distance:.0f}" for distance in distances_m)
