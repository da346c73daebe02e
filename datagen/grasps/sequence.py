"""GraspSequence: the motion of one hand and one object, before anything is drawn."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

__all__ = ["GraspQuality", "GraspSequence", "TableEdge"]

StartKind = Literal["table", "edge", "held"]


@dataclass(frozen=True, kw_only=True)
class TableEdge:
    """A straight table edge in the plane z = 0: the table lies behind it, nothing in front."""

    point_xy_m: tuple[float, float]
    outward_xy: tuple[float, float]  # unit, away from the table


@dataclass(frozen=True, kw_only=True)
class GraspQuality:
    """How good a kept grasp is; measured while it was simulated or read.

    `rise_m` and `center_distance_m` are GraspXL's two success metrics (FORMATS 2.3).
    """

    rise_m: float  # object height at the end minus at the start
    center_distance_m: float  # hand centre to object centre at the end
    max_penetration_m: float  # hand vertices into the object's own mesh, worst instant
    digits_in_contact: int  # of five, at the end
    slip_lift_m: float
    slip_manipulation_m: float  # NaN: nothing but a lift was recorded
    contact_force_n: float  # summed normal force at the end; NaN: recorded without forces
    attempts: int  # simulated until this one was kept, itself included; 0: recorded
    # Smallest signed distance of thumb, index, middle, ring and pinky; median while carried.
    digit_distance_m: Float[np.ndarray, "5"]


@dataclass(frozen=True, kw_only=True)
class GraspSequence:
    """MANO-format hand parameters and object poses at a constant rate (GraspXL layout).

    Hand: axis-angle, MANO joint order (wrist, index, middle, pinky, ring, thumb).
    `hand_pose` holds the full local rotations when `flat_hand_mean` is true and offsets
    from the model's mean pose when it is false, as in smplx. The wrist turns about the
    rest wrist joint; `hand_translation_world` is added last (smplx `transl`).
    """

    sequence_id: str
    object_uid: str
    hand_model: str  # "openhand" or "mano"
    side: Literal["right", "left"]
    fps: float
    flat_hand_mean: bool
    betas: Float[np.ndarray, " beta"]
    hand_orientation_world: Float[np.ndarray, "frame 3"]
    hand_pose: Float[np.ndarray, "frame 45"]
    hand_translation_world: Float[np.ndarray, "frame 3"]
    T_world_from_obj: Float[np.ndarray, "frame 4 4"]
    contact_force_n: Float[np.ndarray, "frame 5"]  # thumb, index, middle, ring, pinky; NaN: recorded without
    grasp_frame: int  # first frame in which the closed hand carries the object
    quality: GraspQuality
    start: StartKind = "table"  # resting on the table, overhanging its edge, or held out in mid-air
    table_edge: TableEdge | None = None  # where the table must end; None: it may reach anywhere
    first_drawn_frame: int = 0  # before it the object may hang in the air (start "held")
    source: Literal["synthesised", "graspxl"] = "synthesised"
    licence: str = ""  # SPDX, of a recorded motion
    stands_in_for: str = ""  # hand model of the recording, where `hand_model` only approximates it
