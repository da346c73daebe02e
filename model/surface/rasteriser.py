"""A z-buffer on NumPy arrays: colour, depth and face of every pixel centre. No anti-aliasing, no GPU, no window."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, Int64, UInt8

from model.errors import ModelError
from model.surface.mesh import SurfaceMesh, vertex_normals
from shards.color import linear_from_srgb, srgb_from_linear

__all__ = ["Raster", "RenderedMesh", "Shading", "rasterise", "render_mesh"]

_CHUNK_PAIRS = 1_000_000


@dataclass(frozen=True, kw_only=True)
class Shading:
    """A lamp at the camera over an even light, and what is behind the object."""

    two_sided: bool  # False skips faces seen from behind: faster, and a closed mesh looks the same
    ambient: float  # share of light from everywhere, 0..1; 1 shows the colours as they are
    background_rgb: tuple[float, float, float]  # sRGB, 0..1


@dataclass(frozen=True, kw_only=True)
class Raster:
    """Which face a pixel centre sees, and where."""

    depth: Float32[np.ndarray, "height width"]  # z in the camera frame, 0 where nothing is hit
    face: Int32[np.ndarray, "height width"]  # -1 where nothing is hit
    barycentric: Float32[np.ndarray, "height width 3"]  # on the face in space, not in the image


@dataclass(frozen=True, kw_only=True)
class RenderedMesh:
    """One image of a mesh."""

    rgb: UInt8[np.ndarray, "height width 3"]
    depth: Float32[np.ndarray, "height width"]  # z in the camera frame, unit of T_cam_from_obj; 0 nothing
    face: Int32[np.ndarray, "height width"]  # -1 nothing

    @property
    def mask(self) -> Bool[np.ndarray, "height width"]:
        return self.face >= 0


def render_mesh(
    mesh: SurfaceMesh,
    K: Float[np.ndarray, "3 3"],
    T_cam_from_obj: Float[np.ndarray, "4 4"],
    image_size: tuple[int, int],
    shading: Shading,
) -> RenderedMesh:
    """The mesh as a pinhole camera sees it, colours and normals interpolated; `image_size` is (width, height).

    `T_cam_from_obj` leads from the mesh's vertices to OpenCV camera axes and may scale. ModelError: a vertex is not in
    front of the camera.
    """
    linear = T_cam_from_obj[:3, :3]
    points_cam = mesh.vertices @ linear.T + T_cam_from_obj[:3, 3]
    raster = rasterise(points_cam, mesh.faces, K, image_size, two_sided=shading.two_sided)
    hit = raster.face >= 0
    corners, weights = mesh.faces[raster.face[hit]], raster.barycentric[hit]
    color = _mix(linear_from_srgb(mesh.colors), corners, weights)
    normals_cam = vertex_normals(mesh) @ (linear / np.cbrt(np.linalg.det(linear))).T
    normal = _mix(normals_cam, corners, weights)
    view = _mix(points_cam, corners, weights)
    lengths = np.sqrt(np.einsum("px,px->p", normal, normal) * np.einsum("px,px->p", view, view))
    facing = np.abs(np.einsum("px,px->p", normal, view)) / np.maximum(lengths, 1e-12)
    light = shading.ambient + (1.0 - shading.ambient) * facing
    rgb = np.empty((*hit.shape, 3))
    rgb[:] = shading.background_rgb
    rgb[hit] = srgb_from_linear(color * light[:, None])
    return RenderedMesh(rgb=np.round(255.0 * rgb).astype(np.uint8), depth=raster.depth, face=raster.face)


def _mix(
    values: Float[np.ndarray, "vertex 3"],
    corners: Int[np.ndarray, "pixel 3"],
    weights: Float[np.ndarray, "pixel 3"],
) -> Float[np.ndarray, "pixel 3"]:
    return np.einsum("pcx,pc->px", values[corners], weights)


def rasterise(
    points_cam: Float[np.ndarray, "vertex 3"],
    faces: Int[np.ndarray, "face 3"],
    K: Float[np.ndarray, "3 3"],
    image_size: tuple[int, int],
    *,
    two_sided: bool,
) -> Raster:
    """The nearest face at every pixel centre, from its front or from either side; equal depths: the lower face number.

    ModelError: a vertex is not in front of the camera (nothing is clipped).
    """
    width, height = image_size
    behind = int(np.count_nonzero(points_cam[:, 2] <= 1e-6))
    if behind:
        raise ModelError(
            "rendering",
            f"{behind} of {len(points_cam)} vertices are not in front of the camera",
            expected="the whole mesh at z > 0",
            action="Move the camera away from the object.",
        )
    uv = points_cam[:, :2] / points_cam[:, 2:] * K[[0, 1], [0, 1]] + K[:2, 2]
    planes = _edge_planes(uv[faces], points_cam[:, 2][faces], two_sided)
    nearest = np.full(width * height, np.iinfo(np.int64).max)
    for face, column, row in _candidates(uv[faces], planes.seen, image_size):
        weights = planes.weights(face, column + 0.5, row + 0.5)
        # A hair wider than the face: rounding must not leave a pixel centre on a common side to neither face.
        least = -1e-9 * weights.sum(axis=0)
        inside = np.flatnonzero((weights[0] >= least) & (weights[1] >= least) & (weights[2] >= least))
        face, pixel = face[inside], row[inside] * width + column[inside]
        depth = (1.0 / weights[:, inside].sum(axis=0)).astype(np.float32)
        # Positive floats sort as their bits do: one number holds the depth and, below it, the face.
        key = depth.view(np.int32).astype(np.int64) << 32 | face
        np.minimum.at(nearest, pixel, key)
    hit = np.flatnonzero(nearest != np.iinfo(np.int64).max)
    face = np.full(width * height, -1, dtype=np.int32)
    face[hit] = nearest[hit] & 0xFFFFFFFF
    depth = np.zeros(width * height, dtype=np.float32)
    barycentric = np.zeros((width * height, 3), dtype=np.float32)
    weights = planes.weights(face[hit], hit % width + 0.5, hit // width + 0.5)
    depth[hit] = 1.0 / weights.sum(axis=0)
    barycentric[hit] = (weights / weights.sum(axis=0)).T
    shape = (height, width)
    return Raster(
        depth=depth.reshape(shape), face=face.reshape(shape), barycentric=barycentric.reshape(*shape, 3)
    )


@dataclass(frozen=True, kw_only=True)
class _EdgePlanes:
    """Per face three linear functions of the image: share of each corner over its depth; their sum is 1 / depth."""

    seen: Bool[np.ndarray, " face"]  # shows a side with an area
    slope_u: Float[np.ndarray, "3 face"]
    slope_v: Float[np.ndarray, "3 face"]
    offset: Float[np.ndarray, "3 face"]  # value at `center`
    center: Float[np.ndarray, "2 face"]

    def weights(
        self, face: Int[np.ndarray, " pair"], u: Float[np.ndarray, " pair"], v: Float[np.ndarray, " pair"]
    ) -> Float[np.ndarray, "3 pair"]:
        du, dv = u - self.center[0, face], v - self.center[1, face]
        return self.slope_u[:, face] * du + self.slope_v[:, face] * dv + self.offset[:, face]


def _edge_planes(
    corners: Float[np.ndarray, "face 3 2"], depth: Float[np.ndarray, "face 3"], two_sided: bool
) -> _EdgePlanes:
    center = corners.mean(axis=1)
    u, v = np.moveaxis(corners - center[:, None], (2, 1), (0, 1))
    # Corner i's share is the area of (pixel, i + 1, i + 2) over the whole.
    u1, v1 = np.roll(u, -1, axis=0), np.roll(v, -1, axis=0)
    du, dv = np.roll(u, 1, axis=0) - u1, np.roll(v, 1, axis=0) - v1
    area = dv[0] * (u[0] - u1[0]) - du[0] * (v[0] - v1[0])
    seen = (np.abs(area) if two_sided else area) > 1e-12
    scale = 1.0 / (np.where(seen, area, 1.0) * depth.T)
    slope_u, slope_v = dv * scale, -du * scale
    return _EdgePlanes(
        seen=seen, slope_u=slope_u, slope_v=slope_v, offset=-(slope_u * u1 + slope_v * v1), center=center.T
    )


def _candidates(
    corners: Float[np.ndarray, "face 3 2"], seen: Bool[np.ndarray, " face"], image_size: tuple[int, int]
) -> Iterator[tuple[Int64[np.ndarray, " pair"], Int64[np.ndarray, " pair"], Int64[np.ndarray, " pair"]]]:
    """Pairs of a face and a pixel within the face's box, as (face, column, row) in chunks."""
    size = np.array(image_size)
    low = np.clip(np.ceil(corners.min(axis=1) - 0.5), 0, size).astype(np.int64)
    high = np.clip(np.floor(corners.max(axis=1) - 0.5) + 1, 0, size).astype(np.int64)
    span = np.maximum(high - low, 0)
    faces = np.flatnonzero((span.prod(axis=1) > 0) & seen)
    low, span = low[faces], span[faces]
    counts = span.prod(axis=1)
    ends = np.cumsum(counts)
    start = 0
    while start < len(faces):
        stop = max(int(np.searchsorted(ends, ends[start] - counts[start] + _CHUNK_PAIRS)), start + 1)
        chunk = counts[start:stop]
        owner = np.repeat(np.arange(start, stop), chunk)
        within = np.arange(len(owner)) - np.repeat(np.cumsum(chunk) - chunk, chunk)
        row, column = np.divmod(within, span[owner, 0])
        yield faces[owner], low[owner, 0] + column, low[owner, 1] + row
        start = stop
