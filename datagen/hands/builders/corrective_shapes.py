"""Pose corrective shapes (MANO's `posedirs`) that undo the collapse of linear skinning.

Linear blending moves a vertex along the chord between its two bones' positions, so flesh at a
bent joint falls towards the pivot. The reference turns it along the arc instead: by its share of
the joint's rotation, about the pivot, which keeps its distance. The blending flesh then moves
along its normals, by at most MAX_SWELLING, to take the hand back to its volume at rest. The
difference from linear skinning, taken back to the rest pose, is fitted to vec(R - I) of that
joint over sampled rotations in its range, and is zero wherever the joint does not blend.
"""

from dataclasses import replace

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from datagen.hands.builders.hand_arrays import HandArrays, descendants
from datagen.hands.builders.relaxed_pose import flexion_axis

__all__ = ["add_corrective_shapes"]

RIDGE = 0.02
N_POSES = 96
MAX_SWELLING = 0.0007  # metres
# Sampled ranges in degrees: flexion low, flexion high, the two other axes both ways.
FINGER_RANGES_DEG = ((-30.0, 95.0, 25.0), (-15.0, 110.0, 8.0), (-15.0, 90.0, 8.0))
THUMB_RANGES_DEG = ((-45.0, 50.0, 40.0), (-30.0, 70.0, 15.0), (-30.0, 90.0, 10.0))


def add_corrective_shapes(hand: HandArrays, rng: np.random.Generator) -> HandArrays:
    """Fit `posedirs` joint by joint."""
    posedirs = np.zeros((len(hand.v_template), 3, 135))
    for joint in range(1, 16):
        rotvecs = _sample_rotations(hand, joint, rng)
        features = (Rotation.from_rotvec(rotvecs).as_matrix() - np.eye(3)).reshape(N_POSES, 9)
        wanted = np.stack([_rest_offset(hand, joint, rotvec) for rotvec in rotvecs])
        gram = features.T @ features + RIDGE * np.eye(9)
        solution = np.linalg.solve(gram, features.T @ wanted.reshape(N_POSES, -1))
        posedirs[..., 9 * (joint - 1) : 9 * joint] = np.moveaxis(solution.reshape(9, -1, 3), 0, 2)
    return replace(hand, posedirs=posedirs)


def _rest_offset(hand: HandArrays, joint: int, rotvec: Float[np.ndarray, "3"]) -> Float[np.ndarray, "vert 3"]:
    """What to add to the rest vertices so that linear skinning gives the reference, one joint turned."""
    share = hand.weights[:, descendants(joint)].sum(axis=1)
    pivot = hand.joints[joint]
    arm = hand.v_template - pivot
    reference = Rotation.from_rotvec(share[:, None] * rotvec).apply(arm)
    reference += _swelling(hand, share, reference)
    R = Rotation.from_rotvec(rotvec).as_matrix()
    linear = (1.0 - share)[:, None, None] * np.eye(3) + share[:, None, None] * R
    blending = ((share > 1e-4) & (share < 1.0 - 1e-4))[:, None]
    return np.where(blending, np.linalg.solve(linear, reference[..., None])[..., 0] - arm, 0.0)


def _swelling(
    hand: HandArrays, share: Float[np.ndarray, " vert"], verts: Float[np.ndarray, "vert 3"]
) -> Float[np.ndarray, "vert 3"]:
    """Offset of the blending flesh along its normals that takes `verts` back to the volume at rest."""
    bell = 4.0 * share * (1.0 - share)
    mesh = trimesh.Trimesh(verts, hand.faces, process=False)
    rest_volume = trimesh.Trimesh(hand.v_template, hand.faces, process=False).volume
    face_share = bell[hand.faces].mean(axis=1)
    height = (rest_volume - mesh.volume) / (mesh.area_faces @ face_share)
    return float(np.clip(height, -MAX_SWELLING, MAX_SWELLING)) * bell[:, None] * mesh.vertex_normals


def _sample_rotations(hand: HandArrays, joint: int, rng: np.random.Generator) -> Float[np.ndarray, "pose 3"]:
    """Half of the poses sweep pure flexion, the other half fill the joint's whole range."""
    ranges = THUMB_RANGES_DEG if joint > 12 else FINGER_RANGES_DEG
    low, high, other = np.deg2rad(ranges[(joint - 1) % 3])
    flexion = flexion_axis(hand, joint)
    side = np.cross(flexion, [0.36, 0.48, 0.80])
    side /= np.linalg.norm(side)
    angles = rng.uniform([low, -other, -other], [high, other, other], (N_POSES, 3))
    angles[: N_POSES // 2] = 0.0
    angles[: N_POSES // 2, 0] = np.linspace(low, high, N_POSES // 2)
    return angles @ np.stack([flexion, side, np.cross(flexion, side)])
