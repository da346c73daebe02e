"""Polygons of any number of corners to triangles, concave ones too."""

import numpy as np
from jaxtyping import Float, Int
from manifold3d import triangulate

__all__ = ["triangulated"]

FLAT = 1e-9  # a corner that turns back by less, relative to the squared area, counts as straight


def triangulated(
    verts: Float[np.ndarray, "vert 3"],
    corners: Int[np.ndarray, " corner"],
    lengths: Int[np.ndarray, " polygon"],
) -> tuple[Int[np.ndarray, "triangle 3"], Int[np.ndarray, " triangle"]]:
    """Triangles of polygons that lie one after the other in `corners` (vertex indices that exist).

    Returns positions in `corners`, so that what belongs to corners can follow, and the polygon of
    each triangle; polygons keep order and winding. Fewer than three corners draw nothing.
    """
    if (lengths == 3).all():
        return np.arange(len(corners)).reshape(-1, 3), np.arange(len(lengths))
    starts = np.cumsum(lengths) - lengths
    triangles, polygon = [np.zeros((0, 3), dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for length in np.unique(lengths[lengths >= 3]):
        rows = np.flatnonzero(lengths == length)
        first = np.arange(1, length - 1)
        fan = np.stack([np.zeros_like(first), first, first + 1], axis=1)
        local = np.broadcast_to(fan, (len(rows), *fan.shape)).copy()
        if length > 3:
            points = verts[corners[starts[rows, None] + np.arange(length)]]
            with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is refused later
                concave = _turns_back(points)
            for row in np.flatnonzero(concave):
                local[row] = _ear_cut(points[row], fan)
        triangles.append((local + starts[rows, None, None]).reshape(-1, 3))
        polygon.append(np.repeat(rows, length - 2))
    of_polygon = np.concatenate(polygon)
    order = np.argsort(of_polygon, kind="stable")
    return np.concatenate(triangles)[order], of_polygon[order]


def _turns_back(points: Float[np.ndarray, "polygon corner 3"]) -> np.ndarray:
    """Whether a polygon has a corner beyond 180 degrees. Not so where a point is NaN."""
    following = np.roll(points, -1, axis=1)
    normal = np.cross(points - points[:, :1], following - points[:, :1]).sum(axis=1)  # Newell's
    turns = np.cross(points - np.roll(points, 1, axis=1), following - points)
    along = np.einsum("pci,pi->pc", turns, normal)
    return (along < -FLAT * (normal**2).sum(axis=1, keepdims=True)).any(axis=1)


def _ear_cut(points: Float[np.ndarray, "corner 3"], fan: Int[np.ndarray, "triangle 3"]) -> np.ndarray:
    """Triangles of one concave polygon, seen along its normal; the fan where that cannot be cut."""
    around = points - points[0]
    normal = np.cross(around, np.roll(around, -1, axis=0)).sum(axis=0)
    axis_u = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    axis_u /= np.linalg.norm(axis_u)
    axis_v = np.cross(normal / np.linalg.norm(normal), axis_u)
    cut = np.asarray(triangulate([np.stack([around @ axis_u, around @ axis_v], axis=1)]), dtype=np.int64)
    return cut if cut.shape == fan.shape else fan
