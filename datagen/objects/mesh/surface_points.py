"""Points on the drawn surface, with the normal and the colour a camera would see there."""

import io
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from PIL import Image

from datagen.objects.mesh.object_mesh import ImageLayout, ObjectMesh
from shards.color import linear_from_srgb, srgb_from_linear
from shards.texture_wrap import Wrap, wrapped_texel

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


def colors_at(
    mesh: ObjectMesh, face: Int[np.ndarray, " point"], barycentric: Float[np.ndarray, "point 3"]
) -> Float[np.ndarray, "point 3"]:
    """sRGB colour without lighting (0..1) of points given by face and barycentric coordinates.

    The base colour (factor, image and corner colours multiplied), or what glows where that is
    brighter, channel by channel: files with baked light are black but for their emissive image.
    """

    def at_points(rows: Float[np.ndarray, "face 3 column"]) -> Float[np.ndarray, "point column"]:
        return np.einsum("pk,pkc->pc", barycentric, rows[face].astype(np.float64))

    uv_layers = [at_points(uv) for uv in (mesh.corner_uv, *mesh.more_corner_uv)]
    tint = None if mesh.corner_colors is None else at_points(mesh.corner_colors)
    material_of_point = mesh.face_material[face]
    colors = np.zeros((len(face), 3))
    for index, material in enumerate(mesh.materials):
        chosen = material_of_point == index
        if not chosen.any():
            continue
        base = _shown(
            material.base_color_rgba[:3],
            material.base_color_image,
            material.base_color_layout,
            uv_layers,
            chosen,
        )
        linear = base if tint is None else base * tint[chosen]
        if any(material.emissive_rgb):
            glow = _shown(
                material.emissive_rgb, material.emissive_image, material.emissive_layout, uv_layers, chosen
            )
            linear = np.maximum(linear, glow)
        colors[chosen] = srgb_from_linear(linear)
    return colors


def _shown(
    factor: tuple[float, ...],
    image: bytes | None,
    layout: ImageLayout,
    uv_layers: list[Float[np.ndarray, "all_point 2"]],
    chosen: Bool[np.ndarray, " all_point"],
) -> Float[np.ndarray, "point 3"]:
    """Linear factor times image at the chosen points."""
    uv = uv_layers[layout.uv_layer][chosen]
    linear = np.broadcast_to(np.asarray(factor, dtype=np.float64), (len(uv), 3))
    return linear if image is None else linear * _image_colors(image, uv, layout)


def _image_colors(
    image: bytes, uv: Float[np.ndarray, "point 2"], layout: ImageLayout
) -> Float[np.ndarray, "point 3"]:
    """Linear colours at `uv`, bilinear between texel centres."""
    pixels = np.asarray(Image.open(io.BytesIO(image), formats=("PNG", "JPEG")).convert("RGB"))
    height, width = pixels.shape[:2]
    x = _folded(uv[:, 0], layout.wrap_u) * width - 0.5
    y = (1.0 - _folded(uv[:, 1], layout.wrap_v)) * height - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]

    def texel(dy: int, dx: int) -> Float[np.ndarray, "point 3"]:
        row, column = (
            wrapped_texel(y0 + dy, height, layout.wrap_v),
            wrapped_texel(x0 + dx, width, layout.wrap_u),
        )
        return linear_from_srgb(pixels[row, column] / 255.0)

    top = (1 - fx) * texel(0, 0) + fx * texel(0, 1)
    bottom = (1 - fx) * texel(1, 0) + fx * texel(1, 1)
    return (1 - fy) * top + fy * bottom


def _folded(coordinate: Float[np.ndarray, " point"], wrap: Wrap) -> Float[np.ndarray, " point"]:
    """An equivalent coordinate near 0..1, as coordinates in files may be huge."""
    if wrap == "clamp":
        return np.clip(coordinate, -1.0, 2.0)
    return np.mod(coordinate, 2.0 if wrap == "mirror" else 1.0)


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
