"""Skin weights: rigid cores around every bone, biharmonic in between."""

import igl
import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.hands.builders.landmarks import CHAINS

__all__ = ["blend_weights", "joint_planes"]

# Half-widths of the bend at each joint, metres: towards the wrist, towards the tip.
_KNUCKLE_M, _MIDDLE_M, _LAST_M = (0.011, 0.009), (0.0055, 0.0055), (0.0045, 0.0045)
_THUMB_M = ((0.0, 0.0), (0.008, 0.007), (0.006, 0.006))
_WRIST_CORE_M = 0.008  # around the wrist ring
_THUMB_ROOT_M = 0.030  # farther than this from the thumb's metacarpal the palm is rigid


def joint_planes(
    verts: Float[np.ndarray, "vert 3"], joints: Float[np.ndarray, "16 3"], tips: dict[str, int]
) -> Float[np.ndarray, "vert 16"]:
    """Signed distance of every vertex beyond the plane that halves each joint's angle (wrist: 0)."""
    distance = np.zeros((len(verts), 16))
    for digit, first in CHAINS.items():
        chain = np.stack([joints[0], *joints[first : first + 3], verts[tips[digit]]])
        direction = np.diff(chain, axis=0)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        for k in range(3):
            normal = direction[k] + direction[k + 1]
            distance[:, first + k] = (verts - joints[first + k]) @ (normal / np.linalg.norm(normal))
    return distance


def blend_weights(
    verts: Float[np.ndarray, "vert 3"],
    faces: Int[np.ndarray, "face 3"],
    joints: Float[np.ndarray, "16 3"],
    tips: dict[str, int],
    digits: dict[str, Float[np.ndarray, "vert"]],
    wrist_loop: Int[np.ndarray, "loop"],
) -> Float[np.ndarray, "vert 16"]:
    """Weights of 16 joints; rows sum to 1, the wrist ring is rigid with the wrist."""
    cores = _cores(verts, joints, tips, digits, wrist_loop)
    if (cores.sum(axis=1) > 1).any():
        raise ValueError(f"{(cores.sum(axis=1) > 1).sum()} vertices lie in the cores of two bones")
    if not cores.any(axis=0).all():
        raise ValueError(f"bones without a core: {np.flatnonzero(~cores.any(axis=0))}")
    fixed = np.flatnonzero(cores.any(axis=1))
    weights = igl.harmonic(verts, faces, fixed, cores[fixed].astype(np.float64), 2)
    weights = np.clip(weights, 0.0, 1.0)
    weights[weights < 0.004] = 0.0
    return weights / weights.sum(axis=1, keepdims=True)


def _cores(
    verts: Float[np.ndarray, "vert 3"],
    joints: Float[np.ndarray, "16 3"],
    tips: dict[str, int],
    digits: dict[str, Float[np.ndarray, "vert"]],
    wrist_loop: Int[np.ndarray, "loop"],
) -> Bool[np.ndarray, "vert 16"]:
    beyond = joint_planes(verts, joints, tips)
    cores = np.zeros((len(verts), 16), dtype=bool)
    palm = np.ones(len(verts), dtype=bool)
    for digit, first in CHAINS.items():
        own = digits[digit] > 0.97
        bends = _THUMB_M if digit == "thumb" else (_KNUCKLE_M, _MIDDLE_M, _LAST_M)
        for k in range(3):
            core = own & (beyond[:, first + k] > bends[k][1])
            if k < 2:
                core &= beyond[:, first + k + 1] < -bends[k + 1][0]
            cores[:, first + k] = core
        if digit != "thumb":
            near_axis = np.abs((verts - joints[first]) @ _across(joints, first)) < 0.013
            palm &= ~(near_axis & (beyond[:, first] > -bends[0][0])) & (digits[digit] < 0.05)
    root, head = joints[13], joints[14]
    along = np.clip((verts - root) @ (head - root) / ((head - root) @ (head - root)), 0.0, 1.0)
    from_thumb = np.linalg.norm(verts - root - along[:, None] * (head - root), axis=1)
    palm &= (from_thumb > _THUMB_ROOT_M) & (beyond[:, [1, 4, 7, 10]].max(axis=1) < -0.004)
    ring = verts[wrist_loop]
    palm |= np.linalg.norm(verts[:, None] - ring[None], axis=-1).min(axis=1) < _WRIST_CORE_M
    cores[:, 0] = palm & ~cores[:, 1:].any(axis=1)
    return cores


def _across(joints: Float[np.ndarray, "16 3"], first: int) -> Float[np.ndarray, "3"]:
    side = np.cross(joints[first + 1] - joints[first], [0.0, 1.0, 0.0])
    return side / np.linalg.norm(side)
