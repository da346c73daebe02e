"""Texture coordinates that continue the skin of the wrist along the forearm."""

import numpy as np
from jaxtyping import Float, Int

__all__ = ["continued_uv"]

_BAND_M = 0.022  # of hand behind the wrist ring that is repeated, back and forth, along the arm


def continued_uv(
    *,
    arm_faces: Int[np.ndarray, "face 3"],
    arm_ring: Float[np.ndarray, "vert 3"],
    arm_distance_m: Float[np.ndarray, " vert"],
    axis: Float[np.ndarray, "3"],
    hand_triangles: Float[np.ndarray, "hand_face 3 3"],
    hand_corner_uv: Float[np.ndarray, "hand_face 3 2"],
) -> Float[np.ndarray, "face 3 2"]:
    """UV of the hand mirrored at the wrist ring and folded back and forth within a short band.

    `arm_ring` is the ring point of each arm vertex's column, `axis` points from the hand into the
    arm. Each arm triangle is laid on the hand triangle nearest to its mirror image and takes that
    triangle's map, so none spans a seam of the texture.
    """
    folded = _BAND_M - np.abs(arm_distance_m % (2 * _BAND_M) - _BAND_M)
    mirrored = (arm_ring - axis * folded[:, None])[arm_faces]
    centers = hand_triangles.mean(axis=1)
    wanted = mirrored.mean(axis=1)
    nearest = np.array([np.linalg.norm(centers - point, axis=1).argmin() for point in wanted])
    return _affine_uv(mirrored, hand_triangles[nearest], hand_corner_uv[nearest])


def _affine_uv(
    points: Float[np.ndarray, "face 3 3"],
    triangles: Float[np.ndarray, "face 3 3"],
    triangle_uv: Float[np.ndarray, "face 3 2"],
) -> Float[np.ndarray, "face 3 2"]:
    """UV of three points per face under the affine map of one triangle (extended beyond its edges)."""
    edges = np.stack([triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]], axis=-1)
    coordinates = np.linalg.pinv(edges) @ np.swapaxes(points - triangles[:, :1], 1, 2)
    uv_edges = np.stack(
        [triangle_uv[:, 1] - triangle_uv[:, 0], triangle_uv[:, 2] - triangle_uv[:, 0]], axis=-1
    )
    return triangle_uv[:, :1] + np.swapaxes(uv_edges @ coordinates, 1, 2)
