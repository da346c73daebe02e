"""Polygons of any number of corners, concave ones too, to triangles."""

import numpy as np
from jaxtyping import Float, Int
from manifold3d import triangulate

__all__ = ["triangulated"]

# Corners that turn inwards by less than this, relative to the polygon's area, are flat.
FLAT_TURN = 1e-9


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
    triangles, polygons = [np.zeros((0, 3), dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for length in np.unique(lengths[lengths >= 3]):
        chosen = np.flatnonzero(lengths == length)
        places = starts[chosen][:, None] + np.arange(length)
        reflex = np.full(len(chosen), -1)
        if length > 3:
            with np.errstate(invalid="ignore", over="ignore"):  # NaN and infinity are refused by others
                reflex = _reflex_corner(verts[corners[places]])
        if length == 4:  # a fan from there fills a concave quadrilateral
            turned = (np.maximum(reflex, 0)[:, None] + np.arange(4)) % 4
            places, reflex = np.take_along_axis(places, turned, axis=1), np.full(len(chosen), -1)
        concave = reflex >= 0
        second = np.arange(1, length - 1)
        fan = np.stack([np.zeros_like(second), second, second + 1], axis=1)
        triangles.append(places[~concave][:, fan].reshape(-1, 3))
        polygons.append(np.repeat(chosen[~concave], length - 2))
        for row in np.flatnonzero(concave):
            local = _clipped(verts[corners[places[row]]], fan)
            triangles.append(places[row][local])
            polygons.append(np.full(len(local), chosen[row]))
    of_polygon = np.concatenate(polygons)
    order = np.argsort(of_polygon, kind="stable")
    return np.concatenate(triangles)[order], of_polygon[order]


def _area_vectors(corners: Float[np.ndarray, "polygon corner 3"]) -> Float[np.ndarray, "polygon 3"]:
    """Newell's normals, twice the area long: right for concave polygons too."""
    return np.cross(corners, np.roll(corners, -1, axis=1)).sum(axis=1)


def _reflex_corner(corners: Float[np.ndarray, "polygon corner 3"]) -> Int[np.ndarray, " polygon"]:
    """The corner of each polygon that turns inwards most, -1 where a fan fills it.

    That is so for convex polygons; those without a normal have no better triangulation.
    """
    corners = corners - corners[:, :1]
    normals = _area_vectors(corners)
    before, after = corners - np.roll(corners, 1, axis=1), np.roll(corners, -1, axis=1) - corners
    turns = np.einsum("pcx,px->pc", np.cross(before, after), normals)
    squared = np.einsum("px,px->p", normals, normals)
    extent = np.ptp(corners, axis=1).max(axis=1)
    has_normal = squared > 1e-24 * extent**4  # not so for NaN
    fills = turns.min(axis=1) >= -FLAT_TURN * squared
    return np.where(has_normal & ~fills, turns.argmin(axis=1), -1)


def _clipped(corners: Float[np.ndarray, "corner 3"], fan: Int[np.ndarray, "triangle 3"]) -> np.ndarray:
    """Triangles of one concave polygon, as indices of its corners; the fan where there are none."""
    corners = (corners - corners[0]) / np.ptp(corners, axis=0).max()
    normal = _area_vectors(corners[None])[0]
    axis_u = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    axis_u /= np.linalg.norm(axis_u)
    axis_v = np.cross(normal / np.linalg.norm(normal), axis_u)
    triangles = triangulate([np.stack([corners @ axis_u, corners @ axis_v], axis=1)])
    return np.asarray(triangles, dtype=np.int64).reshape(-1, 3) if len(triangles) else fan
