"""The table top as triangles: one builder for Blender and for the exact geometry buffers.

A slab with rounded plan corners and rounded edges. Its upper face is a flat polygon in the plane
z = `Table.top_z_m`, which the ray caster meets in closed form.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.scene.scene import Table

__all__ = ["TableMesh", "inside_flat_top", "table_from_world", "table_mesh"]

CORNER_SEGMENTS = 10  # per quarter turn of the outline
EDGE_SEGMENTS = 5  # per quarter turn of the edge's profile
CORNER_RADIUS_M = 0.035
EDGE_RADIUS_M = 0.006


@dataclass(frozen=True, kw_only=True)
class TableMesh:
    """A closed slab, faces outward. Vertices are shared, so shade it smooth with 40 degree auto-smooth."""

    verts_world: Float[np.ndarray, "vert 3"]  # metres
    faces: Int[np.ndarray, "face 3"]


def table_mesh(table: Table) -> TableMesh:
    """Triangles of the slab: rings from the flat top over the rounded edge down to the flat bottom.

    Raises ValueError when the table is thinner or narrower than its roundings.
    """
    edge = _edge_radius_m(table)
    if min(table.size_xy_m) <= 2.0 * CORNER_RADIUS_M or edge <= 0.0:
        raise ValueError(
            f"table of {table.size_xy_m} m and {table.thickness_m} m thickness: sides must exceed "
            f"{2.0 * CORNER_RADIUS_M} m and the thickness 0; enlarge the table"
        )
    angle = np.linspace(0.0, 0.5 * np.pi, EDGE_SEGMENTS + 1)
    inset = edge * (1.0 - np.sin(angle))
    drop = edge * (1.0 - np.cos(angle))
    inset = np.concatenate([inset, inset[::-1]])
    z = table.top_z_m - np.concatenate([drop, table.thickness_m - drop[::-1]])

    rings = [
        np.column_stack([_to_world(table, _outline(table, float(i))), np.full(4 * (CORNER_SEGMENTS + 1), h)])
        for i, h in zip(inset, z)
    ]
    size = len(rings[0])
    poles = np.array([[*table.center_xy_m, z[0]], [*table.center_xy_m, z[-1]]])
    return TableMesh(
        verts_world=np.concatenate([*rings, poles]),
        faces=_ring_faces(len(rings), size),
    )


def table_from_world(table: Table) -> Float[np.ndarray, "2 3"]:
    """[R | t]: (x, y) of the world to the table's own axes about its centre, metres."""
    R = _turn(table)
    return np.column_stack([R, -R @ np.asarray(table.center_xy_m)])


def inside_flat_top(
    table: Table, x_table: Float[np.ndarray, "*batch"], y_table: Float[np.ndarray, "*batch"]
) -> Bool[np.ndarray, "*batch"]:
    """True where a point of the table's own plane lies on the flat polygon of `table_mesh`."""
    edge = _edge_radius_m(table)
    x, y = np.abs(x_table), np.abs(y_table)
    half_x, half_y = 0.5 * table.size_xy_m[0], 0.5 * table.size_xy_m[1]
    inside = (x <= half_x - edge) & (y <= half_y - edge)
    # Only in the four corners does the outline differ from a rectangle.
    corner = inside & (x > half_x - CORNER_RADIUS_M) & (y > half_y - CORNER_RADIUS_M)
    points = np.stack([x_table[corner], y_table[corner]], axis=-1)
    inside[corner] = _inside_convex(_outline(table, edge), points)
    return inside


def _inside_convex(
    outline: Float[np.ndarray, "corner 2"], points: Float[np.ndarray, "point 2"]
) -> Bool[np.ndarray, " point"]:
    side = np.roll(outline, -1, axis=0) - outline
    normal = np.stack([-side[:, 1], side[:, 0]], axis=-1)  # points inward
    return np.all(points @ normal.T >= np.sum(normal * outline, axis=-1), axis=-1)


def _edge_radius_m(table: Table) -> float:
    return min(EDGE_RADIUS_M, 0.45 * table.thickness_m)


def _turn(table: Table) -> Float[np.ndarray, "2 2"]:
    """R_local_from_world in the plane."""
    c, s = np.cos(table.yaw_rad), np.sin(table.yaw_rad)
    return np.array([[c, s], [-s, c]])


def _outline(table: Table, inset_m: float) -> Float[np.ndarray, "corner 2"]:
    """Rounded rectangle about the origin, shrunk by `inset_m`, counter-clockwise."""
    half = 0.5 * np.asarray(table.size_xy_m) - CORNER_RADIUS_M
    radius = CORNER_RADIUS_M - inset_m
    angle = np.linspace(0.0, 0.5 * np.pi, CORNER_SEGMENTS + 1)
    quarters = []
    for turn, sign in enumerate([(1, 1), (-1, 1), (-1, -1), (1, -1)]):
        a = angle + 0.5 * np.pi * turn
        quarters.append(half * sign + radius * np.stack([np.cos(a), np.sin(a)], axis=-1))
    return np.concatenate(quarters)


def _to_world(table: Table, points: Float[np.ndarray, "corner 2"]) -> Float[np.ndarray, "corner 2"]:
    return points @ _turn(table) + np.asarray(table.center_xy_m)


def _ring_faces(n_rings: int, size: int) -> Int[np.ndarray, "face 3"]:
    """Two triangles per cell between neighbouring rings (first ring on top), a fan on either pole."""
    here, after = np.arange(size), (np.arange(size) + 1) % size
    top_pole, bottom_pole = n_rings * size, n_rings * size + 1
    fans = [
        np.stack([np.full(size, top_pole), here, after], axis=-1),
        np.stack(
            [np.full(size, bottom_pole), (n_rings - 1) * size + after, (n_rings - 1) * size + here], axis=-1
        ),
    ]
    walls = []
    for ring in range(n_rings - 1):
        upper, lower = ring * size, (ring + 1) * size
        walls.append(np.stack([upper + here, lower + here, lower + after], axis=-1))
        walls.append(np.stack([upper + here, lower + after, upper + after], axis=-1))
    return np.concatenate(fans + walls)
