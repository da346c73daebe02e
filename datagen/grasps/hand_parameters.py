"""A hand's motion in the terms of `pose_hand`, and the hand centre of GraspXL."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.hands.model import PosedHand

__all__ = ["HandParameters", "hand_center"]

FINGER_MIDDLE_JOINTS = [2, 5, 8, 11]  # PIP
THUMB_TIP = 16  # row of PosedHand.joints_world


@dataclass(frozen=True, kw_only=True)
class HandParameters:
    """A motion in the terms of `pose_hand` (flat_hand_mean)."""

    orientation_world: Float[np.ndarray, "frame 3"]
    hand_pose: Float[np.ndarray, "frame 45"]
    translation_world: Float[np.ndarray, "frame 3"]


def hand_center(posed: PosedHand) -> Float[np.ndarray, "instant 3"]:
    """GraspXL's hand centre: halfway between the thumb tip and the fingers' middle joints."""
    fingers = posed.joints_world[:, FINGER_MIDDLE_JOINTS].mean(1)
    return 0.5 * (fingers + posed.joints_world[:, THUMB_TIP])
