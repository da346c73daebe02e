"""Voxels that a surface passes through, exactly (triangle against box)."""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

__all__ = ["surface_voxels"]

CHUNK_PAIRS = 2_000_000


def surface_voxels(
    verts_canonical: Float[np.ndarray, "vert 3"], faces: Int[np.ndarray, "face 3"], resolution: int
) -> UInt8[np.ndarray, "voxel 3"]:
    """Indices of the voxels of [-0.5, 0.5]^3 that any triangle touches, sorted.

    Vertices beyond the cube are clipped to it, as TRELLIS does (FORMATS 4.5).
    """
    verts = (np.clip(verts_canonical, -0.5 + 1e-6, 0.5 - 1e-6) + 0.5) * resolution
    corners = verts[faces]
    low = np.clip(np.floor(corners.min(axis=1)).astype(np.int64), 0, resolution - 1)
    high = np.clip(np.floor(corners.max(axis=1)).astype(np.int64), 0, resolution - 1)
    span = high - low + 1
    pairs = span.prod(axis=1)
    occupied = np.zeros((resolution,) * 3, dtype=bool)
    ends = np.cumsum(pairs)
    start = 0
    while start < len(faces):
        stop = max(int(np.searchsorted(ends, ends[start] - pairs[start] + CHUNK_PAIRS)), start + 1)
        _mark(occupied, corners[start:stop], low[start:stop], span[start:stop])
        start = stop
    return np.argwhere(occupied).astype(np.uint8)


def _mark(
    occupied: Bool[np.ndarray, "x y z"],
    corners: Float[np.ndarray, "face 3 3"],
    low: Int[np.ndarray, "face 3"],
    span: Int[np.ndarray, "face 3"],
) -> None:
    counts = span.prod(axis=1)
    face = np.repeat(np.arange(len(corners)), counts)
    within = np.arange(len(face)) - np.repeat(np.cumsum(counts) - counts, counts)
    size_y, size_z = span[face, 1], span[face, 2]
    offset = np.stack([within // (size_y * size_z), within // size_z % size_y, within % size_z], axis=1)
    voxel = low[face] + offset
    touched = _overlaps(corners[face] - (voxel + 0.5)[:, None])
    occupied[tuple(voxel[touched].T)] = True


def _overlaps(triangle: Float[np.ndarray, "pair 3 3"]) -> Bool[np.ndarray, " pair"]:
    """Separating axes of a triangle and the cube [-0.5, 0.5]^3 around the origin."""
    edges = np.roll(triangle, -1, axis=1) - triangle
    normal = np.cross(edges[:, 0], edges[:, 1])
    distance = np.abs((normal * triangle[:, 0]).sum(axis=1))
    touching = distance <= 0.5 * np.abs(normal).sum(axis=1)
    touching &= (triangle.min(axis=1) <= 0.5).all(axis=1) & (triangle.max(axis=1) >= -0.5).all(axis=1)
    for axis in np.eye(3):
        for k in range(3):
            direction = np.cross(axis, edges[:, k])
            reach = 0.5 * np.abs(direction).sum(axis=1)
            shadow = np.einsum("pkc,pc->pk", triangle, direction)
            touching &= (shadow.min(axis=1) <= reach) & (shadow.max(axis=1) >= -reach)
    return touching
