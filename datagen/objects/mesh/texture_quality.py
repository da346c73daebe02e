"""Texture quality: how much an image would show of this object's surface."""

import io
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from PIL import Image

from datagen.objects.mesh.object_mesh import ObjectMesh
from datagen.objects.mesh.surface_points import SurfaceSamples, sample_surface

__all__ = ["TextureQuality", "measure_texture_quality", "texture_samples"]

N_POINTS = 4096
NEIGHBOUR_M = 0.002  # two points this far apart are told apart in a 512 px image of the object
FULL_DETAIL = 0.10  # mean absolute difference of neighbours that counts as 1


@dataclass(frozen=True, kw_only=True)
class TextureQuality:
    """Measured on the surface, so unused texture area does not count.

    `texture_resolution_px` is the square root of the texels that lie on the surface, or of the
    vertices that have a colour where there is no texture (0 without either). `color_detail` is 0
    for one plain colour and 1 for strong detail everywhere: half from the spread of colours
    (entropy of a 4x4x4 colour histogram over 4 bit), half from how much colour changes over 2 mm.
    """

    texture_resolution_px: int
    color_detail: float  # 0..1


def _texel_count(mesh: ObjectMesh) -> float:
    """Places with a colour of their own, summed over materials; overlapping UVs count once at most."""
    count = 0.0
    for index, material in enumerate(mesh.materials):
        chosen = mesh.face_material == index
        image, layout = material.base_color_image, material.base_color_layout
        if image is None and any(material.emissive_rgb):
            image, layout = material.emissive_image, material.emissive_layout
        if image is not None:
            width, height = Image.open(io.BytesIO(image), formats=("PNG", "JPEG")).size
            count += min(_uv_area(mesh.uv_of(layout)[chosen]), 1.0) * width * height
        elif mesh.corner_colors is not None:
            tinted = (mesh.corner_colors != 1.0).any(axis=(1, 2))
            count += len(np.unique(mesh.faces[chosen & tinted]))
    return count


def _uv_area(uv: Float[np.ndarray, "face 3 2"]) -> float:
    edge_a, edge_b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return float((0.5 * np.abs(edge_a[:, 0] * edge_b[:, 1] - edge_a[:, 1] * edge_b[:, 0])).sum())


def _histogram_entropy(colors: Float[np.ndarray, "point 3"]) -> float:
    """Entropy in bits of colours in 4x4x4 bins (sRGB, 0..1)."""
    cells = np.minimum((colors * 4).astype(int), 3) @ np.array([16, 4, 1])
    share = np.bincount(cells, minlength=64) / len(colors)
    share = share[share > 0]
    return float(-(share * np.log2(share)).sum())


def texture_samples(mesh: ObjectMesh) -> SurfaceSamples:
    """The points that texture quality is measured on. Deterministic."""
    return sample_surface(mesh, N_POINTS, np.random.default_rng(0), jitter_m=NEIGHBOUR_M)


def measure_texture_quality(mesh: ObjectMesh, samples: SurfaceSamples | None = None) -> TextureQuality:
    """Texture resolution and colour detail of the drawn surface; `samples` are its `texture_samples`."""
    samples = texture_samples(mesh) if samples is None else samples
    entropy = min(_histogram_entropy(samples.colors) / 4.0, 1.0)
    change = float(np.abs(samples.colors - samples.neighbour_colors).mean())
    detail = 0.5 * entropy + 0.5 * min(change / FULL_DETAIL, 1.0)
    return TextureQuality(
        texture_resolution_px=round(np.sqrt(_texel_count(mesh))), color_detail=round(detail, 6)
    )
