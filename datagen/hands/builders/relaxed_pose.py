"""The mean pose: how an idle hand hangs, fingers slightly and increasingly flexed."""

from dataclasses import replace

import numpy as np
import trimesh
from jaxtyping import Float

from datagen.hands.builders.hand_arrays import HandArrays, digit_chain
from shards.joints import DIGIT_JOINTS

__all__ = ["flexion_axis", "set_mean_pose"]

THUMB_NAIL_VERTEX = 878  # centre of the nail in the base mesh
DORSAL = np.array([0.0, 1.0, 0.0])
# Palmar abduction with pronation at the saddle joint, degrees about x (fingers point to -x).
THUMB_ABDUCTION_DEG = 24.0
# Flexion in degrees, from the base of the digit. Ulnar fingers curl more.
RELAXED_DEG = {
    "thumb": (3.0, 8.0, 12.0),
    "index": (12.0, 22.0, 10.0),
    "middle": (17.0, 26.0, 12.0),
    "ring": (19.0, 27.0, 12.0),
    "pinky": (18.0, 26.0, 12.0),
}
FINGER_SPREAD_DEG = {"index": -3.0, "middle": 0.0, "ring": 3.0, "pinky": 7.0}  # about +y; gathers the fingers


def set_mean_pose(hand: HandArrays) -> HandArrays:
    """`hands_mean` from flexions about each digit's own axis."""
    mean = np.zeros((15, 3))
    for digit, flexions in RELAXED_DEG.items():
        for joint, flexion in zip(DIGIT_JOINTS[digit], flexions):
            mean[joint - 1] = np.deg2rad(flexion) * flexion_axis(hand, joint)
        if digit in FINGER_SPREAD_DEG:
            mean[DIGIT_JOINTS[digit][0] - 1] += np.deg2rad(FINGER_SPREAD_DEG[digit]) * DORSAL
    mean[DIGIT_JOINTS["thumb"][0] - 1] += np.deg2rad([THUMB_ABDUCTION_DEG, 0.0, 0.0])
    return replace(hand, hands_mean=mean.reshape(45))


def flexion_axis(hand: HandArrays, joint: int) -> Float[np.ndarray, "3"]:
    """Unit axis about which positive angles close the digit.

    Fingers flex towards the palm, the thumb away from its nail.
    """
    digit = next(name for name, joints in DIGIT_JOINTS.items() if joint in joints)
    chain = digit_chain(hand, digit)
    if digit == "thumb":
        nail = trimesh.Trimesh(hand.v_template, hand.faces, process=False).vertex_normals[THUMB_NAIL_VERTEX]
        axis = np.cross(chain[3] - chain[1], -nail)
    else:
        axis = np.cross(chain[1] - chain[0], -DORSAL)
    return axis / np.linalg.norm(axis)
