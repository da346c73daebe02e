"""True surfaces beside predicted meshes, from the same camera."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8

from model.data.batch import SurfaceTarget
from model.surface.mesh import SurfaceMesh
from model.surface.rasteriser import Shading, render_mesh
from shards.geometry import intrinsics_from_fov, look_at, project_points, transform_points

__all__ = ["comparison"]

_TILE_PX = 192
_FOV_RAD = 0.42  # all but the outermost corners of the canonical cube
_DOT_PX = 2  # half-width
_ROWS = 4
_SHADING = Shading(two_sided=False, ambient=0.35, background_rgb=(1.0, 1.0, 1.0))


def comparison(
    rows: Sequence[tuple[SurfaceTarget, Sequence[SurfaceMesh | None]]],
) -> UInt8[np.ndarray, "height width 3"]:
    """A row per object, four at most: its surface points, then each mesh; white where there is no mesh."""
    K = intrinsics_from_fov(_FOV_RAD, (_TILE_PX, _TILE_PX))
    camera = np.array([1.6, -2.6, 1.6])
    T_cam_from_canonical = look_at(camera[None], np.zeros((1, 3)))[0]
    images = []
    for truth, meshes in rows[:_ROWS]:
        tiles = [_points_image(truth, K, T_cam_from_canonical)]
        for mesh in meshes:
            if mesh is None:
                tiles.append(_blank())
            else:
                size = (_TILE_PX, _TILE_PX)
                tiles.append(render_mesh(mesh, K, T_cam_from_canonical, size, _SHADING).rgb)
        images.append(np.concatenate(tiles, axis=1))
    return np.concatenate(images, axis=0) if images else _blank()


def _points_image(
    truth: SurfaceTarget, K: Float[np.ndarray, "3 3"], T_cam_from_canonical: Float[np.ndarray, "4 4"]
) -> UInt8[np.ndarray, "tile tile 3"]:
    """The points that face the camera as small squares, near ones over far ones, shaded as meshes are."""
    points_cam = transform_points(T_cam_from_canonical, truth.points.astype(np.float64))
    normals_cam = truth.normals @ T_cam_from_canonical[:3, :3].T
    facing = -np.einsum("px,px->p", normals_cam, points_cam) / np.linalg.norm(points_cam, axis=1)
    pixels = project_points(points_cam, K)
    seen = np.flatnonzero((facing > 0) & ((pixels >= 0) & (pixels < _TILE_PX)).all(axis=1))
    seen = seen[np.argsort(-points_cam[seen, 2])]
    shade = _SHADING.ambient + (1.0 - _SHADING.ambient) * facing[seen, None]
    colors = np.round(truth.colors[seen] * shade ** (1 / 2.2)).astype(np.uint8)
    columns, rows = np.floor(pixels[seen]).astype(int).T
    image = _blank()
    for row, column, color in zip(rows, columns, colors):
        image[max(row - _DOT_PX, 0) : row + _DOT_PX + 1, max(column - _DOT_PX, 0) : column + _DOT_PX + 1] = (
            color
        )
    return image


def _blank() -> UInt8[np.ndarray, "tile tile 3"]:
    return np.full((_TILE_PX, _TILE_PX, 3), 255, dtype=np.uint8)
