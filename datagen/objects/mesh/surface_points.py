"""Points on the drawn surface, with the normal and the colour a camera would see there."""

import io
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from PIL import Image

from datagen.objects.mesh.object_mesh import Material, ObjectMesh
from shards.color import linear_from_srgb, srgb_from_linear

__all__ = [
    "SurfaceSamples",
    "colors_at",
    "face_areas",
    "face_normals",
    "sample_surface",
]


@dataclass(frozen=True, kw_only=True)
class SurfaceSamples:
    """Points spread evenly over the area. Colours are sRGB in 0..1, without lighting."""

    points_obj: Float[np.ndarray, "point 3"]
    normals_obj: Float[np.ndarray, "point 3"]  # of the face
    colors: Float[np.ndarray, "point 3"]
    neighbour_colors: Float[np.ndarray, "point 3"]  # `jitter_m` away in the same plane
    face: Int[np.ndarray, " point"]


def _doubled_area_normals(
    verts: Float[np.ndarray, "vert 3"], faces: Int[np.ndarray, "face 3"]
) -> Float[np.ndarray, "face 3"]:
    a, b, c = (verts[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def face_areas(
    verts: Float[np.ndarray, "vert 3"], faces: Int[np.ndarray, "face 3"]
) -> Float[np.ndarray, " face"]:
    """Area of every triangle in squared units of the vertices."""
    return 0.5 * np.linalg.norm(_doubled_area_normals(verts, faces), axis=1)


def face_normals(
    verts: Float[np.ndarray, "vert 3"], faces: Int[np.ndarray, "face 3"]
) -> Float[np.ndarray, "face 3"]:
    """Unit normals by the right-hand rule; (0, 0, 0) for degenerate triangles."""
    normals = _doubled_area_normals(verts, faces)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)


def _image_colors(image: bytes, uv: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "point 3"]:
    """Linear colours at `uv` (repeating image, bilinear between texel centres)."""
    pixels = np.asarray(Image.open(io.BytesIO(image)).convert("RGB"), dtype=np.float64) / 255.0
    pixels = linear_from_srgb(pixels)
    height, width = pixels.shape[:2]
    x = np.mod(uv[:, 0], 1.0) * width - 0.5
    y = (1.0 - np.mod(uv[:, 1], 1.0)) * height - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]

    def texel(dy: int, dx: int) -> Float[np.ndarray, "point 3"]:
        return pixels[(y0 + dy) % height, (x0 + dx) % width]

    top = (1 - fx) * texel(0, 0) + fx * texel(0, 1)
    bottom = (1 - fx) * texel(1, 0) + fx * texel(1, 1)
    return (1 - fy) * top + fy * bottom


def _material_colors(material: Material, uv: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "point 3"]:
    factor = np.asarray(material.base_color_rgba[:3], dtype=np.float64)
    linear = np.broadcast_to(factor, (len(uv), 3))
    if material.base_color_image is not None:
        linear = linear * _image_colors(material.base_color_image, uv)
    return srgb_from_linear(linear)


def colors_at(
    mesh: ObjectMesh, face: Int[np.ndarray, " point"], barycentric: Float[np.ndarray, "point 3"]
) -> Float[np.ndarray, "point 3"]:
    """sRGB base colour (0..1) of points given by face and barycentric coordinates."""
    uv = np.einsum("pk,pkc->pc", barycentric, mesh.corner_uv[face].astype(np.float64))
    material_of_point = mesh.face_material[face]
    colors = np.zeros((len(face), 3))
    for index, material in enumerate(mesh.materials):
        chosen = material_of_point == index
        if chosen.any():
            colors[chosen] = _material_colors(material, uv[chosen])
    return colors


def sample_surface(
    mesh: ObjectMesh, count: int, rng: np.random.Generator, *, jitter_m: float = 0.0
) -> SurfaceSamples:
    """`count` points, area-uniform (one per equal-area stratum), with normal and colour."""
    cumulative = np.cumsum(face_areas(mesh.verts_obj, mesh.faces))
    strata = (np.arange(count) + rng.random(count)) / count * cumulative[-1]
    face = np.minimum(np.searchsorted(cumulative, strata, side="right"), len(mesh.faces) - 1)
    root, r2 = np.sqrt(rng.random(count)), rng.random(count)
    barycentric = np.stack([1 - root, root * (1 - r2), root * r2], axis=1)
    corners = mesh.verts_obj[mesh.faces[face]]
    normals = face_normals(mesh.verts_obj, mesh.faces)[face]
    moved = barycentric + _barycentric_step(corners, normals, jitter_m, rng)
    return SurfaceSamples(
        points_obj=np.einsum("pk,pkc->pc", barycentric, corners),
        normals_obj=normals,
        colors=colors_at(mesh, face, barycentric),
        neighbour_colors=colors_at(mesh, face, moved),
        face=face,
    )


def _barycentric_step(
    corners: Float[np.ndarray, "point 3 3"],
    normals: Float[np.ndarray, "point 3"],
    length: float,
    rng: np.random.Generator,
) -> Float[np.ndarray, "point 3"]:
    """Change of barycentric coordinates for a step of `length` in a random in-plane direction."""
    edge_b, edge_c = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    unit_b = edge_b / np.maximum(np.linalg.norm(edge_b, axis=1, keepdims=True), 1e-12)
    angle = rng.random(len(corners))[:, None] * 2 * np.pi
    step = length * (np.cos(angle) * unit_b + np.sin(angle) * np.cross(normals, unit_b))
    gram = np.stack([(edge_b**2).sum(1), (edge_b * edge_c).sum(1), (edge_c**2).sum(1)], axis=1)
    determinant = np.maximum(gram[:, 0] * gram[:, 2] - gram[:, 1] ** 2, 1e-24)
    on_b, on_c = (step * edge_b).sum(1), (step * edge_c).sum(1)
    beta = (gram[:, 2] * on_b - gram[:, 1] * on_c) / determinant
    gamma = (gram[:, 0] * on_c - gram[:, 1] * on_b) / determinant
    return np.stack([-beta - gamma, beta, gamma], axis=1)
