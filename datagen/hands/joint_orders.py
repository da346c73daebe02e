"""Joint orders of other people's data, as indices into ours.

Ours: the 16 joints of MANO (`JOINT_NAMES`), then the tips of thumb, index, middle, ring and pinky.
"""

import numpy as np
from jaxtyping import Float

from datagen.hands.model import DIGITS, JOINT_NAMES

__all__ = [
    "HO3D_ORDER",
    "MEDIAPIPE_ORDER",
    "OPENPOSE_ORDER",
    "joint_names",
    "reordered_joints",
    "reordered_joints_back",
]

_NAMES = (*JOINT_NAMES, *(f"{digit}_tip" for digit in DIGITS))

# Wrist, then each digit from its base to its tip, thumb to pinky. The joints that manopth returns are
# in this order (`manopth:manolayer.py`); HO-3D's own code calls it the simple order (`vis_HO3D.py`).
OPENPOSE_ORDER = (0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20)

# `HandLandmark` of MediaPipe: WRIST, THUMB_CMC .. THUMB_TIP, INDEX_FINGER_MCP .. PINKY_TIP.
MEDIAPIPE_ORDER = OPENPOSE_ORDER

# `handJoints3D` of HO-3D: MANO's order, then the tips thumb to pinky, as ours (`vis_HO3D.py` turns it
# into the simple order with the indices above).
HO3D_ORDER = tuple(range(21))


def joint_names(order: tuple[int, ...]) -> tuple[str, ...]:
    """Our names of the joints in that order: "wrist", "thumb1" .. "thumb3", "thumb_tip", ..."""
    return tuple(_NAMES[joint] for joint in order)


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
