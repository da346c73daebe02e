"""Closes the wrist with a slightly domed cap of concentric rings."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from datagen.hands.builders.hand_arrays import HandArrays

__all__ = ["close_wrist"]

RINGS = (0.85, 0.6, 0.3)  # radius of each ring, as a fraction of the border
DOME = 0.004  # metres beyond the border at the centre


def close_wrist(hand: HandArrays) -> HandArrays:
    """Append the cap's vertices and faces. It moves with the wrist and takes the border's texture."""
    loop = hand.wrist_loop
    n, n_border = len(hand.v_template), len(loop)
    blend = _cap_blend(n_border)
    outward = _outward(hand)
    radius = np.array([r for r in RINGS for _ in range(n_border)] + [0.0])
    dome = DOME * np.outer(1.0 - radius**2, outward)
    faces, spoke = _cap_faces(loop, n)
    n_cap = len(blend)
    return replace(
        hand,
        v_template=np.vstack([hand.v_template, blend @ hand.v_template[loop] + dome]),
        shapedirs=np.concatenate([hand.shapedirs, np.einsum("cl,lkb->ckb", blend, hand.shapedirs[loop])]),
        posedirs=np.concatenate([hand.posedirs, np.zeros((n_cap, 3, 135))]),
        J_regressor=np.hstack([hand.J_regressor, np.zeros((16, n_cap))]),
        weights=np.vstack([hand.weights, np.eye(16)[np.zeros(n_cap, dtype=int)]]),
        faces=np.vstack([hand.faces, faces]),
        corner_uv=np.concatenate([hand.corner_uv, _border_uv(hand)[spoke]]),
    )


def _cap_blend(n_border: int) -> Float[np.ndarray, "cap loop"]:
    """Cap vertices as mixtures of the border: rings shrunk to the mean, then the centre."""
    mean = np.full((n_border, n_border), 1.0 / n_border)
    rings = [r * np.eye(n_border) + (1.0 - r) * mean for r in RINGS]
    return np.vstack([*rings, mean[:1]])


def _outward(hand: HandArrays) -> Float[np.ndarray, "3"]:
    """Unit normal of the border's mean plane, away from the hand."""
    ring = hand.v_template[hand.wrist_loop]
    ring = ring - ring.mean(axis=0)
    normal = np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0)
    normal /= np.linalg.norm(normal)
    inside = hand.v_template.mean(axis=0) - hand.v_template[hand.wrist_loop].mean(axis=0)
    return normal if normal @ inside < 0 else -normal


def _cap_faces(
    loop: Int[np.ndarray, " loop"], n_verts: int
) -> tuple[Int[np.ndarray, "face 3"], Int[np.ndarray, "face 3"]]:
    """Outward faces, and for each corner the border vertex (0..loop-1) it looks like.

    The loop follows the half-edges of the hand's own faces, so the cap runs them backwards.
    """
    n = len(loop)
    here = np.arange(n)
    after = np.roll(here, -1)
    rings = [loop, *(n_verts + k * n + here for k in range(len(RINGS)))]
    faces, spokes = [], []
    for outer, inner in pairwise(rings):
        faces += [
            np.stack([outer[after], outer, inner], axis=1),
            np.stack([outer[after], inner, inner[after]], axis=1),
        ]
        spokes += [np.stack([after, here, here], axis=1), np.stack([after, here, after], axis=1)]
    centre = np.full(n, n_verts + len(RINGS) * n)
    faces.append(np.stack([rings[-1][after], rings[-1], centre], axis=1))
    spokes.append(np.stack([after, here, here], axis=1))
    return np.vstack(faces), np.vstack(spokes)


def _border_uv(hand: HandArrays) -> Float[np.ndarray, "loop 2"]:
    """A texture coordinate of every border vertex: the first of its corners."""
    corners = hand.faces.reshape(-1)
    first = [int(np.argmax(corners == vertex)) for vertex in hand.wrist_loop]
    return hand.corner_uv.reshape(-1, 2)[first]
