"""Images of the clean object from all sides, of which features are made (FORMATS 4.5).

TRELLIS: 150 cameras of a Hammersley sphere at radius 2, 40 degrees wide, colours on black. Its images are path
traced; ours show the base colours under a lamp at the camera, so that a shape of one colour is more than a silhouette.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from scipy.stats import qmc

from model.structured_latent.object_features.object_mesh import TexturedMesh
from model.surface.rasteriser import rasterise
from shards.color import linear_from_srgb, srgb_from_linear
from shards.geometry import intrinsics_from_fov, look_at
from shards.texture_wrap import Wrap, wrapped_texel

__all__ = ["RENDERING", "ObjectView", "object_views", "sphere_cameras"]

FOV_DEG, RADIUS = 40.0, 2.0  # canonical units
AMBIENT = 0.5  # share of the light that comes from everywhere
REFLECTANCE = 0.04  # of what is not metal: black things do not vanish before the black
RENDERING = f"views 2: {FOV_DEG} {RADIUS} {AMBIENT} {REFLECTANCE}"
"""Changes with anything that changes the images of an object: part of what a cached feature is known by."""

_MAX_LEVELS = 16  # of an image of 65,535 texels across
_LINEAR = linear_from_srgb(np.arange(256, dtype=np.float32) / 255)


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectView:
    """One image and its camera."""

    image: UInt8[np.ndarray, "size size 3"]  # sRGB times coverage
    K: Float[np.ndarray, "3 3"]
    T_cam_from_canonical: Float[np.ndarray, "4 4"]

    def mirrored(self) -> "ObjectView":
        """The image of the object in the mirror, x -> -x as `model.data.crop.mirrored`: its own inverse."""
        F = np.diag([-1.0, 1.0, 1.0, 1.0])
        K = self.K.copy()
        K[0, 2] = self.image.shape[1] - K[0, 2]
        return ObjectView(
            image=np.ascontiguousarray(self.image[:, ::-1]),
            K=K,
            T_cam_from_canonical=F @ self.T_cam_from_canonical @ F,
        )


def sphere_cameras(count: int) -> Float[np.ndarray, "view 4 4"]:
    """`T_cam_from_canonical`, evenly around the object, three quarters of them from above as TRELLIS has them.

    Point i is ((i + 1/2) / count, i's bits mirrored at the binary point); the half keeps off the poles.
    """
    u = (np.arange(count) + 0.5) / count
    v = qmc.Halton(1, scramble=False).random(count)[:, 0]
    u = np.where(u < 0.25, 2.0 * u, 2.0 / 3.0 * u + 1.0 / 3.0)
    height, azimuth = 2.0 * u - 1.0, 2.0 * np.pi * v
    across = np.sqrt(1.0 - height**2)
    centers = RADIUS * np.stack([across * np.cos(azimuth), across * np.sin(azimuth), height], axis=1)
    return look_at(centers, np.zeros_like(centers))


def object_views(mesh: TexturedMesh, count: int, image_size: int, supersampling: int) -> Iterator[ObjectView]:
    """The images of the object, one after the other; sides rendered larger by `supersampling`, then averaged."""
    large = image_size * supersampling
    K = intrinsics_from_fov(np.deg2rad(FOV_DEG), (image_size, image_size))
    K_large = intrinsics_from_fov(np.deg2rad(FOV_DEG), (large, large))
    pyramids = [_pyramid(texture) for texture in mesh.textures]
    for T_cam_from_canonical in sphere_cameras(count):
        image = _image(mesh, pyramids, K_large, T_cam_from_canonical, large)
        blocks = image.reshape(image_size, supersampling, image_size, supersampling, 3)
        yield ObjectView(
            image=np.round(255.0 * blocks.mean(axis=(1, 3))).astype(np.uint8),
            K=K,
            T_cam_from_canonical=T_cam_from_canonical,
        )


_Pyramid = list[UInt8[np.ndarray, "_ _ 3"]]


def _image(
    mesh: TexturedMesh,
    pyramids: list[_Pyramid],
    K: Float[np.ndarray, "3 3"],
    T_cam_from_canonical: Float[np.ndarray, "4 4"],
    size: int,
) -> Float32[np.ndarray, "size size 3"]:
    """sRGB of every pixel centre, black beside the object."""
    points_cam = mesh.vertices @ T_cam_from_canonical[:3, :3].T + T_cam_from_canonical[:3, 3]
    raster = rasterise(points_cam, mesh.faces, K, (size, size), two_sided=True)
    hit = raster.face >= 0
    face, weights = raster.face[hit], raster.barycentric[hit]
    corners = mesh.faces[face]

    def mixed(values: Float[np.ndarray, "vertex column"]) -> Float32[np.ndarray, "pixel column"]:
        return np.einsum("pcx,pc->px", values[corners], weights).astype(np.float32)

    normal, view = mixed(mesh.normals @ T_cam_from_canonical[:3, :3].T), mixed(points_cam)
    lengths = np.sqrt(np.einsum("px,px->p", normal, normal) * np.einsum("px,px->p", view, view))
    facing = np.abs(np.einsum("px,px->p", normal, view)) / np.maximum(lengths, 1e-12)

    points_px = points_cam[:, :2] / points_cam[:, 2:] * K[0, 0]
    level = _levels(mesh, pyramids, points_px)[face]
    color = mixed(mesh.colors)
    choice, uv = mesh.face_texture[face] * _MAX_LEVELS + level, mixed(mesh.uv)
    for found in np.flatnonzero(np.bincount(choice)):
        texture = found // _MAX_LEVELS
        level_image = pyramids[texture][found % _MAX_LEVELS]
        pixels = np.flatnonzero(choice == found)
        color[pixels] *= _texels(level_image, uv[pixels], mesh.wraps[texture])
    image = np.zeros((size, size, 3), dtype=np.float32)
    light = AMBIENT + (1.0 - AMBIENT) * facing
    image[hit] = srgb_from_linear((REFLECTANCE + (1.0 - REFLECTANCE) * color) * light[:, None])
    return image


def _pyramid(texture: UInt8[np.ndarray, "height width 3"]) -> _Pyramid:
    """The image, and means of it with half the sides each, down to one texel across."""
    levels = [texture]
    while min(levels[-1].shape[:2]) > 1:
        height, width = levels[-1].shape[:2]
        levels.append(cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA))
    return levels


def _levels(
    mesh: TexturedMesh, pyramids: list[_Pyramid], points_px: Float[np.ndarray, "vertex 2"]
) -> Int[np.ndarray, " face"]:
    """Level of the pyramid whose texels are about as large as the pixels, per face.

    Along the direction in which the image is least shrunk, as anisotropic filters choose it: an image that is squeezed
    in one direction, as around the poles of a ball, stays sharp in the other. Supersampling has to average the former.
    """
    sizes = np.array([image.shape[1::-1] for image, *_ in pyramids])
    deepest = np.array([len(pyramid) - 1 for pyramid in pyramids])
    texels = _edges(mesh.uv[mesh.faces] * sizes[mesh.face_texture][:, None])
    pixels = _edges(points_px[mesh.faces])
    area = pixels[:, 0, 0] * pixels[:, 1, 1] - pixels[:, 0, 1] * pixels[:, 1, 0]
    inverse = np.stack([pixels[:, 1, 1], -pixels[:, 0, 1], -pixels[:, 1, 0], pixels[:, 0, 0]], axis=1)
    inverse = inverse.reshape(-1, 2, 2) / np.where(np.abs(area) > 1e-9, area, 1.0)[:, None, None]
    texels_per_pixel = np.linalg.svd(inverse @ texels, compute_uv=False)[:, 1]
    level = np.round(np.log2(np.maximum(texels_per_pixel, 1.0)))
    return np.minimum(level, deepest[mesh.face_texture]).astype(np.int64)


def _edges(corners: Float[np.ndarray, "face 3 2"]) -> Float[np.ndarray, "face 2 2"]:
    return corners[:, 1:] - corners[:, :1]


def _texels(
    image: UInt8[np.ndarray, "height width 3"], uv: Float[np.ndarray, "pixel 2"], wraps: tuple[Wrap, Wrap]
) -> Float32[np.ndarray, "pixel 3"]:
    """Linear light between the four nearest texels."""
    height, width = image.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1.0 - uv[:, 1]) * height - 0.5
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    right, down = (x - column)[:, None], (y - row)[:, None]

    def at(
        row: Int[np.ndarray, " pixel"], column: Int[np.ndarray, " pixel"]
    ) -> Float32[np.ndarray, "pixel 3"]:
        return _LINEAR[image[wrapped_texel(row, height, wraps[1]), wrapped_texel(column, width, wraps[0])]]

    above = (1.0 - right) * at(row, column) + right * at(row, column + 1)
    below = (1.0 - right) * at(row + 1, column) + right * at(row + 1, column + 1)
    return ((1.0 - down) * above + down * below).astype(np.float32)
