"""Closed surface of an open, torn or self-intersecting mesh, by a level set on a fine grid.

The field is `side * distance - offset`, sampled near the surface only.

- `side` is -1 in what air cannot reach: a flood from outside, stopped by the surface and by
  holes narrower than `max_hole_m`. A cup without a lid stays a cup; a bottle whose mesh has a
  slit stays full. Next to the surface, where the grid is too coarse to flood, the generalised
  winding number decides.
- `offset` gives thickness where there is none: a single sheet becomes `sheet_voxels` thick, half
  on either side, and closed walls thinner than that are widened to it. Elsewhere it is 0.
"""

from dataclasses import dataclass
from typing import Annotated

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from datagen.objects.mesh.outward_faces import ray_intersector
from datagen.objects.mesh.surface_points import face_normals
from shards.settings import Range

__all__ = ["LevelSetConfig", "level_set_surface"]

BAND = 2  # grid steps around the surface that carry values
PADDING = 5
BARRIER = 0.51  # in voxels: two neighbours on opposite sides cannot both be farther off


@dataclass(frozen=True, kw_only=True)
class LevelSetConfig:
    """Resolution of the level set and what counts as closed."""

    voxels_longest: Annotated[int, Range(16, 2048)]  # grid steps along the longest side
    min_voxel_m: Annotated[float, Range(1e-6, 1)]
    max_hole_m: Annotated[float, Range(0, 1)]  # holes narrower than this are closed
    # thickness of single sheets; at least 1.75 or the grid loses them
    sheet_voxels: Annotated[float, Range(1.75, 100)]

    def voxel_m(self, verts: Float[np.ndarray, "vert 3"]) -> float:
        """Grid step for a mesh of this size."""
        return max(float(np.ptp(verts, axis=0).max()) / self.voxels_longest, self.min_voxel_m)


@dataclass(frozen=True, kw_only=True)
class _Band:
    """Grid nodes near the surface."""

    index: Int[np.ndarray, "node 3"]
    shape: tuple[int, int, int]
    distance: Float[np.ndarray, " node"]
    face: Int[np.ndarray, " node"]
    nearest: Float[np.ndarray, "node 3"]
    points: Float[np.ndarray, "node 3"]
    origin: Float[np.ndarray, "3"]
    voxel: float

    def dense(self, chosen: Bool[np.ndarray, " node"]) -> Bool[np.ndarray, "x y z"]:
        grid = np.zeros(self.shape, dtype=bool)
        grid[tuple(self.index[chosen].T)] = True
        return grid

    def lookup(
        self, grid: Bool[np.ndarray, "x y z"], points: Float[np.ndarray, "point 3"]
    ) -> Bool[np.ndarray, " point"]:
        """Value at the node nearest to each point."""
        index = np.rint((points - self.origin) / self.voxel).astype(np.int64)
        index = np.clip(index, 0, np.array(self.shape) - 1)
        return grid[tuple(index.T)]


def level_set_surface(
    verts: Float[np.ndarray, "vert 3"], faces: Int[np.ndarray, "face 3"], config: LevelSetConfig
) -> tuple[Float[np.ndarray, "out_vert 3"], Int[np.ndarray, "out_face 3"]]:
    """Vertices and outward faces of a closed manifold that follows the mesh."""
    verts, faces = np.ascontiguousarray(verts, np.float64), np.ascontiguousarray(faces, np.int64)
    band = _band(verts, faces, config.voxel_m(verts))
    unreached = _unreached(band, config.max_hole_m)
    side, wall = _side_and_wall(verts, faces, band, unreached)
    thinnest = 0.5 * config.sheet_voxels * band.voxel
    offset = np.maximum(thinnest - 0.5 * wall, 0.0)
    patch_index, patch_values = _patch_over_holes(band, unreached)
    return _marching(
        np.concatenate([band.index, patch_index]),
        np.concatenate([side * band.distance - offset, patch_values]),
        band,
    )


def _band(verts: Float[np.ndarray, "vert 3"], faces: Int[np.ndarray, "face 3"], voxel: float) -> _Band:
    origin = verts.min(axis=0) - PADDING * voxel
    extent = verts.max(axis=0) + PADDING * voxel - origin
    shape = tuple(int(n) for n in np.ceil(extent / voxel).astype(int) + 1)
    near = np.zeros(shape, dtype=bool)
    for points in _covering_points(verts, faces, 0.7 * voxel):
        near[tuple(np.rint((points - origin) / voxel).astype(np.int64).T)] = True
    near = ndimage.binary_dilation(near, structure=np.ones((3, 3, 3), bool), iterations=BAND)
    index = np.argwhere(near)
    points = origin + voxel * index
    squared, face, nearest = igl.point_mesh_squared_distance(points, verts, faces)
    return _Band(
        index=index,
        shape=shape,  # type: ignore[arg-type]
        distance=np.sqrt(squared),
        face=face.astype(np.int64),  # igl's long long is another type to NumPy
        nearest=nearest,
        points=points,
        origin=origin,
        voxel=voxel,
    )


def _covering_points(
    verts: Float[np.ndarray, "vert 3"], faces: Int[np.ndarray, "face 3"], spacing: float
) -> list[Float[np.ndarray, "point 3"]]:
    """Points on every triangle, no farther than `spacing` apart."""
    corners = verts[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(np.ceil(longest / spacing).astype(int), 1)
    clouds = []
    for n in np.unique(steps):
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
        inside = i + j <= n
        barycentric = np.stack([n - i - j, i, j], axis=-1)[inside] / n
        clouds.append(np.einsum("bk,fkc->fbc", barycentric, corners[steps == n]).reshape(-1, 3))
    return clouds


def _unreached(band: _Band, max_hole_m: float) -> Bool[np.ndarray, "x y z"]:
    """Nodes off the surface that air from outside cannot reach."""
    barrier = band.dense(band.distance < BARRIER * band.voxel)
    unreached = ~barrier & ~_connected_to_corner(~barrier)
    # Holes up to `max_hole_m` are closed: flood what is farther than half of it from the surface,
    # and let the pockets that stay dry grow back to the surface.
    reach = 0.5 * max_hole_m / band.voxel
    if reach > BARRIER:
        far = ndimage.distance_transform_edt(~barrier) > reach
        pockets = far & ~_connected_to_corner(far)
        if pockets.any():
            unreached |= ndimage.binary_dilation(pockets, iterations=int(np.ceil(reach)) + 1, mask=~barrier)
    return unreached


def _connected_to_corner(free: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    labels, _ = ndimage.label(free)
    return labels == labels[0, 0, 0]


def _side_and_wall(
    verts: Float[np.ndarray, "vert 3"],
    faces: Int[np.ndarray, "face 3"],
    band: _Band,
    unreached: Bool[np.ndarray, "x y z"],
) -> tuple[Float[np.ndarray, " node"], Float[np.ndarray, " node"]]:
    """-1 inside and +1 outside, and the wall thickness (metres) at each node's nearest point."""
    normals = face_normals(verts, faces)[band.face]
    rays = ray_intersector(verts, faces)
    gap = 1e-3 * band.voxel
    far_m = 1e3
    thickness = np.full(len(band.face), far_m)
    hits, ray, _ = rays.intersects_location(band.nearest - gap * normals, -normals, multiple_hits=False)
    thickness[ray] = np.linalg.norm(hits - band.nearest[ray], axis=1)
    # A wall is solid if the point half way through it is.
    middle = band.nearest - normals * np.minimum(0.5 * thickness, 2.0 * band.voxel)[:, None]
    is_thin = thickness < 2.0 * band.voxel
    watertight_behind = band.lookup(unreached, middle)
    thin_middle = np.ascontiguousarray(middle[is_thin])
    watertight_behind[is_thin] |= igl.fast_winding_number(verts, faces, thin_middle) > 0.5
    watertight_in_front = band.lookup(unreached, band.nearest + 2.0 * band.voxel * normals)
    next_to_surface = band.distance < BARRIER * band.voxel
    inside = unreached[tuple(band.index.T)] & ~next_to_surface
    unclear = next_to_surface & watertight_behind
    winding = igl.fast_winding_number(verts, faces, np.ascontiguousarray(band.points[unclear]))
    inside[unclear] = (winding > 0.5) | watertight_in_front[unclear]
    return np.where(inside, -1.0, 1.0), np.where(watertight_behind, thickness, 0.0)


def _patch_over_holes(
    band: _Band, unreached: Bool[np.ndarray, "x y z"]
) -> tuple[Int[np.ndarray, "patch_node 3"], Float[np.ndarray, " patch_node"]]:
    """Nodes (and values) where the border of what air cannot reach leaves the surface's band."""
    in_band = band.dense(np.ones(len(band.index), dtype=bool))
    block = np.ones((3, 3, 3), bool)
    on_surface = band.dense(band.distance < BARRIER * band.voxel)
    border = unreached & ndimage.binary_dilation(~unreached & ~on_surface)
    nodes = ndimage.binary_dilation(border, block, iterations=BAND) & ~in_band
    filled = ndimage.gaussian_filter(unreached.astype(np.float32), sigma=1.0)
    index = np.argwhere(nodes)
    return index, (0.5 - filled[tuple(index.T)].astype(np.float64)) * 2.0 * band.voxel


def _marching(
    index: Int[np.ndarray, "node 3"], values: Float[np.ndarray, " node"], band: _Band
) -> tuple[Float[np.ndarray, "vert 3"], Int[np.ndarray, "face 3"]]:
    """Marching cubes over the cells whose eight nodes all carry values."""
    row_of_node = np.full(band.shape, -1, dtype=np.int64)
    row_of_node[tuple(index.T)] = np.arange(len(index))
    # Corner order of the marching table: around the lower face, then around the upper one.
    offsets = np.array(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
    )
    corners = np.stack([row_of_node[tuple((index + offset).T)] for offset in offsets], axis=1)
    corners = corners[(corners >= 0).all(axis=1)]
    # A node exactly on the surface would tear it open there.
    values = np.where(np.abs(values) < 1e-5 * band.voxel, 1e-5 * band.voxel, values)
    negative = values[corners] < 0
    cells = np.ascontiguousarray(corners[negative.any(axis=1) & ~negative.all(axis=1)])
    verts, faces, _ = igl.marching_cubes(values, band.origin + band.voxel * index, cells, 0.0)
    return verts, faces.astype(np.int64)
