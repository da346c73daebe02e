"""Exact ray casting of triangle meshes through pixel centres.

Embree finds the triangle in float32; the depth is then computed again in float64 from the
triangle's plane. Rays are scaled to z = 1 in the camera, so the ray parameter is the depth.
"""

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Int

from shards.geometry import invert_transform, transform_points

__all__ = ["Hits", "PixelWindow", "TriangleCaster", "cast_window", "pixel_rays", "projected_window"]

# Plane and Embree agree to ~1e-6 of the distance; where they differ by more the ray grazes the
# triangle's border edge-on, and the plane's value would lie outside the triangle.
MAX_RELATIVE_DISAGREEMENT = 1e-4


@dataclass(frozen=True, kw_only=True)
class PixelWindow:
    """A rectangle of pixels, [x0, x1) x [y0, y1)."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)"""
        return max(self.y1 - self.y0, 0), max(self.x1 - self.x0, 0)

    @property
    def slices(self) -> tuple[slice, slice]:
        """Indexes an image (height, width, ...)."""
        return slice(self.y0, self.y1), slice(self.x0, self.x1)


@dataclass(frozen=True, kw_only=True)
class Hits:
    """First surface met by every ray of a window."""

    depth: Float[np.ndarray, "*ray"]  # metres along camera z; inf where nothing is hit
    triangle: Int[np.ndarray, "*ray"]  # -1 where nothing is hit


class TriangleCaster:
    """A mesh with its bounding volume hierarchy; rays are cast in the mesh's own frame."""

    def __init__(self, verts: Float[np.ndarray, "vert 3"], faces: Int[np.ndarray, "face 3"]) -> None:
        self.verts = verts
        corners = verts[faces]
        self.normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._offsets = np.einsum("fi,fi->f", self.normals, corners[:, 0])
        self._scene = EmbreeScene(robust=True)  # watertight along shared edges
        self._mesh = TriangleMesh(self._scene, verts.astype(np.float32), faces.astype(np.int32))

    def cast(self, T_mesh_from_cam: Float[np.ndarray, "4 4"], rays_cam: Float[np.ndarray, "ray 3"]) -> Hits:
        """Depth and triangle of the first hit from the camera centre. `rays_cam` have z = 1."""
        if len(rays_cam) == 0:
            return Hits(depth=np.zeros(0), triangle=np.zeros(0, np.int32))
        center = T_mesh_from_cam[:3, 3]
        rays = rays_cam @ T_mesh_from_cam[:3, :3].T
        origins = np.tile(center.astype(np.float32), (len(rays), 1))
        found = self._scene.run(origins, rays.astype(np.float32), output=True)
        triangle = found["primID"]
        hit = np.flatnonzero(triangle >= 0)
        depth = np.full(len(rays), np.inf)
        depth[hit] = self._plane_depth(
            center, rays[hit], triangle[hit], found["tfar"][hit].astype(np.float64)
        )
        return Hits(depth=depth, triangle=triangle)

    def _plane_depth(
        self,
        center: Float[np.ndarray, "3"],
        rays: Float[np.ndarray, "hit 3"],
        triangle: Int[np.ndarray, " hit"],
        embree_depth: Float[np.ndarray, " hit"],
    ) -> Float[np.ndarray, " hit"]:
        normal = self.normals[triangle]
        height = self._offsets[triangle] - normal @ center
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = height / np.einsum("hi,hi->h", normal, rays)
            agree = np.abs(depth - embree_depth) <= MAX_RELATIVE_DISAGREEMENT * embree_depth
        return np.where(agree, depth, embree_depth)

    def unit_normals_cam(
        self,
        T_mesh_from_cam: Float[np.ndarray, "4 4"],
        triangle: Int[np.ndarray, " hit"],
        rays_cam: Float[np.ndarray, "hit 3"],
    ) -> Float[np.ndarray, "hit 3"]:
        """Geometric unit normals in the camera frame, turned against the ray; 0 without area."""
        normal = self.normals[triangle] @ T_mesh_from_cam[:3, :3]
        length = np.sqrt(np.einsum("hi,hi->h", normal, normal))
        away = np.einsum("hi,hi->h", normal, rays_cam) > 0.0
        return normal * (np.where(away, -1.0, 1.0) / np.maximum(length, 1e-300))[:, None]


def projected_window(
    verts: Float[np.ndarray, "vert 3"],
    T_cam_from_mesh: Float[np.ndarray, "4 4"],
    K: Float[np.ndarray, "3 3"],
    image_size: tuple[int, int],
) -> PixelWindow:
    """Smallest window of pixels whose centres can see the mesh; the whole image if a vertex is behind."""
    width, height = image_size
    points = transform_points(T_cam_from_mesh, verts)
    z = points[:, 2]
    if z.min() <= 1e-6:
        return PixelWindow(x0=0, y0=0, x1=width, y1=height)
    u = points[:, 0] / z * K[0, 0] + K[0, 2]
    v = points[:, 1] / z * K[1, 1] + K[1, 2]
    # One pixel of slack: rounding must never cut a hit off.
    x0, x1 = np.clip([np.floor(u.min()) - 1, np.ceil(u.max()) + 1], 0, width).astype(int)
    y0, y1 = np.clip([np.floor(v.min()) - 1, np.ceil(v.max()) + 1], 0, height).astype(int)
    return PixelWindow(x0=int(x0), y0=int(y0), x1=int(x1), y1=int(y1))


def pixel_rays(
    K: Float[np.ndarray, "3 3"],
    window: PixelWindow,
    row: Int[np.ndarray, " pixel"],
    column: Int[np.ndarray, " pixel"],
) -> Float[np.ndarray, "pixel 3"]:
    """Rays through the centres of some pixels of a window, camera frame, z = 1."""
    rays = np.ones((len(row), 3))
    rays[:, 0] = (column + (window.x0 + 0.5 - K[0, 2])) / K[0, 0]
    rays[:, 1] = (row + (window.y0 + 0.5 - K[1, 2])) / K[1, 1]
    return rays


def cast_window(
    caster: TriangleCaster,
    T_cam_from_mesh: Float[np.ndarray, "4 4"],
    K: Float[np.ndarray, "3 3"],
    window: PixelWindow,
) -> Hits:
    """`TriangleCaster.cast` for every pixel of a window; the results are (height, width)."""
    row, column = np.divmod(np.arange(np.prod(window.shape)), max(window.shape[1], 1))
    rays = pixel_rays(K, window, row, column)
    hits = caster.cast(invert_transform(T_cam_from_mesh), rays)
    return Hits(depth=hits.depth.reshape(window.shape), triangle=hits.triangle.reshape(window.shape))
