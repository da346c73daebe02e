"""Pose corrective shapes (MANO's `posedirs`) that undo the collapse of linear skinning.

Linear blending moves a vertex along the chord between its two bones' positions, so flesh at a
bent joint falls towards the pivot. The reference turns it along the arc instead: by its share of
the joint's rotation, about the pivot, which keeps its distance and with it the volume. The
difference, taken back to the rest pose, is fitted linearly to vec(R - I) of that joint over
sampled rotations in its range, and is zero wherever the joint does not blend.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from datagen.hands.builders.hand_arrays import HandArrays, descendants
from datagen.hands.builders.relaxed_pose import flexion_axis

__all__ = ["add_corrective_shapes", "arc_correction"]

RIDGE = 0.02
N_POSES = 96
# Sampled ranges in degrees: flexion low, high; then the two other axes, both ways.
RANGES_DEG = {0: (-30.0, 95.0, 25.0), 1: (-15.0, 110.0, 8.0), 2: (-15.0, 90.0, 8.0)}
THUMB_RANGES_DEG = {0: (-45.0, 50.0, 40.0), 1: (-30.0, 70.0, 15.0), 2: (-30.0, 90.0, 10.0)}
GAIN = 1.0  # of the arc correction


def add_corrective_shapes(hand: HandArrays, rng: np.random.Generator) -> HandArrays:
    """Fit `posedirs` joint by joint."""
    posedirs = np.zeros((len(hand.v_template), 3, 135))
    for joint in range(1, 16):
        rotvecs = _sample_rotations(hand, joint, rng)
        R = Rotation.from_rotvec(rotvecs).as_matrix()
        features = (R - np.eye(3)).reshape(len(R), 9)
        wanted = np.stack([arc_correction(hand, joint, rotvec) for rotvec in rotvecs])
        gram = features.T @ features + RIDGE * np.eye(9)
        solution = np.linalg.solve(gram, features.T @ wanted.reshape(len(R), -1))
        posedirs[..., 9 * (joint - 1) : 9 * joint] = GAIN * np.moveaxis(solution.reshape(9, -1, 3), 0, 2)
    return replace(hand, posedirs=posedirs)


def arc_correction(hand: HandArrays, joint: int, rotvec: Float[np.ndarray, "3"]) -> Float[np.ndarray, "vert 3"]:
    """Rest-pose offset that makes linear skinning follow the arc when one joint turns by `rotvec`."""
    share = hand.weights[:, descendants(joint)].sum(axis=1)
    blending = (share > 1e-4) & (share < 1.0 - 1e-4)
    R = Rotation.from_rotvec(rotvec).as_matrix()
    linear = (1.0 - share[blending])[:, None, None] * np.eye(3) + share[blending][:, None, None] * R
    arm = hand.v_template[blending] - hand.joints[joint]
    arc = Rotation.from_rotvec(share[blending][:, None] * rotvec).apply(arm)
    offset = np.zeros_like(hand.v_template)
    offset[blending] = np.linalg.solve(linear, arc[..., None])[..., 0] - arm
    return offset


def _sample_rotations(hand: HandArrays, joint: int, rng: np.random.Generator) -> Float[np.ndarray, "pose 3"]:
    order = (joint - 1) % 3
    low, high, other = np.deg2rad((THUMB_RANGES_DEG if joint > 12 else RANGES_DEG)[order])
    flexion = flexion_axis(hand, joint)
    side = np.cross(flexion, [0.36, 0.48, 0.80])
    side /= np.linalg.norm(side)
    third = np.cross(flexion, side)
    angles = rng.uniform([low, -other, -other], [high, other, other], (N_POSES, 3))
    angles[: N_POSES // 2, 1:] = 0.0
    angles[: N_POSES // 2, 0] = np.linspace(low, high, N_POSES // 2)
    return angles @ np.stack([flexion, side, third])
