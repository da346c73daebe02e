"""The joints of a hand: their names and order in the format, and the orders of other people's data."""

from typing import Literal, get_args

import numpy as np

from shards.array_types import Float

__all__ = [
    "DIGITS",
    "DIGIT_JOINTS",
    "HO3D_ORDER",
    "JOINTS",
    "MANO_JOINTS",
    "MEDIAPIPE_ORDER",
    "OPENPOSE_ORDER",
    "Digit",
    "joint_names",
    "reordered_joints",
    "reordered_joints_back",
]

Digit = Literal["thumb", "index", "middle", "ring", "pinky"]
DIGITS: tuple[Digit, ...] = get_args(Digit)  # of tips and of whatever is measured per digit

MANO_JOINTS = (
    "wrist",
    *(f"{digit}{k}" for digit in ("index", "middle", "pinky", "ring", "thumb") for k in (1, 2, 3)),
)
JOINTS = (*MANO_JOINTS, *(f"{digit}_tip" for digit in DIGITS))  # rows of joints_world and joints_px

# The three joints of each digit from its base outward, as indices into JOINTS.
DIGIT_JOINTS: dict[str, tuple[int, int, int]] = {
    digit: (JOINTS.index(f"{digit}1"), JOINTS.index(f"{digit}2"), JOINTS.index(f"{digit}3"))
    for digit in DIGITS
}

# Orders of other people's data, as indices into JOINTS.

# Wrist, then each digit from its base to its tip, thumb to pinky. The joints that manopth returns are
# in this order (`manopth:manolayer.py`); HO-3D's own code calls it the simple order (`vis_HO3D.py`).
OPENPOSE_ORDER = (
    0,
    *(joint for digit in DIGITS for joint in (*DIGIT_JOINTS[digit], JOINTS.index(f"{digit}_tip"))),
)

# `HandLandmark` of MediaPipe: WRIST, THUMB_CMC .. THUMB_TIP, INDEX_FINGER_MCP .. PINKY_TIP.
MEDIAPIPE_ORDER = OPENPOSE_ORDER

# `handJoints3D` of HO-3D: MANO's order, then the tips thumb to pinky, as ours (`vis_HO3D.py` turns it
# into the simple order with the indices above).
HO3D_ORDER = tuple(range(len(JOINTS)))


def joint_names(order: tuple[int, ...]) -> tuple[str, ...]:
    """Our names of the joints in that order: "wrist", "thumb1" .. "thumb3", "thumb_tip", ..."""
    return tuple(JOINTS[joint] for joint in order)


def reordered_joints(
    joints: Float[np.ndarray, "*batch 21 values"], order: tuple[int, ...]
) -> Float[np.ndarray, "*batch 21 values"]:
    """Joints in our order to the given one: row k of the result is row order[k] of the input."""
    return joints[..., list(order), :]


def reordered_joints_back(
    joints: Float[np.ndarray, "*batch 21 values"], order: tuple[int, ...]
) -> Float[np.ndarray, "*batch 21 values"]:
    """Joints in the given order to ours: the inverse of `reordered_joints`."""
    return joints[..., np.argsort(order), :]
