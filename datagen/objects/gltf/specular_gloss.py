"""KHR_materials_pbrSpecularGlossiness to metallic-roughness.

Both models give a reflectance for normal incidence and a diffuse colour,

    specular-gloss:      F0 = specular,                       c_diff = diffuse * (1 - max specular)
    metallic-roughness:  F0 = (1 - m) * 0.04 + m * base,      c_diff = (1 - m) * (1 - 0.04) * base

(glTF 2.0 appendix B and the extension's specification). Equal brightness of both gives a
quadratic for the metallic share m; the base colour then follows from either line.
"""

import io
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from PIL import Image

from datagen.objects.files.texture_images import decoded_rgba
from shards.color import linear_from_srgb, srgb_from_linear

__all__ = ["MetallicRoughness", "SpecularGloss", "metallic_roughness"]

DIELECTRIC_F0 = 0.04
PERCEIVED = np.array([0.299, 0.587, 0.114])  # weights of squares, as in Khronos' reference conversion
ROWS_AT_ONCE = 128


@dataclass(frozen=True, kw_only=True)
class SpecularGloss:
    """The extension's values; images are PNG or JPEG files (sRGB colour, linear alpha)."""

    diffuse_rgba: tuple[float, float, float, float]  # linear
    diffuse_image: bytes | None
    specular_rgb: tuple[float, float, float]  # linear, reflectance at normal incidence
    glossiness: float
    specular_gloss_image: bytes | None  # RGB specular, A glossiness


@dataclass(frozen=True, kw_only=True)
class MetallicRoughness:
    """The same look as `Material` states it."""

    base_color_rgba: tuple[float, float, float, float]
    base_color_image: bytes | None
    metallic: float
    roughness: float
    metallic_roughness_image: bytes | None


def metallic_roughness(look: SpecularGloss) -> MetallicRoughness:
    """Converted texel by texel where an image tells metal from paint, else by factors alone.

    Without a specular-gloss image and with a specular up to that of common dielectrics the diffuse
    image stays as it is. Images of different size are read at the larger size.
    """
    no_metal = max(look.specular_rgb) <= DIELECTRIC_F0
    if look.specular_gloss_image is None and (no_metal or look.diffuse_image is None):
        diffuse = np.array([look.diffuse_rgba[:3]])
        base, metallic = _converted(diffuse, np.array([look.specular_rgb]))
        if no_metal:
            base, metallic = diffuse, np.zeros(1)  # the small change of brightness is not worth a new image
        r, g, b = (float(value) for value in base[0])
        return MetallicRoughness(
            base_color_rgba=(r, g, b, float(look.diffuse_rgba[3])),
            base_color_image=look.diffuse_image,
            metallic=float(metallic[0]),
            roughness=1.0 - look.glossiness,
            metallic_roughness_image=None,
        )
    base_image, surface_image = _converted_images(look)
    return MetallicRoughness(
        base_color_rgba=(1.0, 1.0, 1.0, float(look.diffuse_rgba[3])),
        base_color_image=base_image,
        metallic=1.0,
        roughness=1.0,
        metallic_roughness_image=surface_image,
    )


def _converted(
    diffuse: Float[np.ndarray, "texel 3"], specular: Float[np.ndarray, "texel 3"]
) -> tuple[Float[np.ndarray, "texel 3"], Float[np.ndarray, " texel"]]:
    """Linear base colour and metallic share of linear diffuse and specular colours."""
    f0 = DIELECTRIC_F0
    remaining = 1.0 - specular.max(axis=1)
    bright_diffuse = np.sqrt((diffuse**2) @ PERCEIVED)
    bright_specular = np.sqrt((specular**2) @ PERCEIVED)
    # f0 m^2 + b m + c = 0, from eliminating the base colour.
    b = bright_diffuse * remaining / (1.0 - f0) + bright_specular - 2.0 * f0
    c = f0 - bright_specular
    root = np.sqrt(np.maximum(b * b - 4.0 * f0 * c, 0.0))
    metallic = np.where(bright_specular < f0, 0.0, np.clip((root - b) / (2.0 * f0), 0.0, 1.0))
    share = metallic[:, None]
    of_diffuse = diffuse * remaining[:, None] / (1.0 - f0) / np.maximum(1.0 - share, 1e-6)
    of_specular = (specular - f0 * (1.0 - share)) / np.maximum(share, 1e-6)
    # Each line is ill-conditioned at one end; the square favours the diffuse one until it fails.
    base = of_diffuse + share**2 * (of_specular - of_diffuse)
    return np.clip(base, 0.0, 1.0), metallic


def _converted_images(look: SpecularGloss) -> tuple[bytes, bytes]:
    """PNGs of base colour (alpha kept) and of glTF's metallic-roughness (G roughness, B metallic)."""
    opened = [
        None if image is None else decoded_rgba(image)
        for image in (look.diffuse_image, look.specular_gloss_image)
    ]
    size = max((image.size for image in opened if image is not None), key=lambda side: side[0] * side[1])
    diffuse, gloss = (
        None if image is None else np.asarray(image if image.size == size else image.resize(size))
        for image in opened
    )
    width, height = size
    base = np.empty((height, width, 4), dtype=np.uint8)
    surface = np.zeros((height, width, 3), dtype=np.uint8)
    for top in range(0, height, ROWS_AT_ONCE):  # whole images in floats would take gigabytes
        rows = slice(top, min(top + ROWS_AT_ONCE, height))
        shape = (rows.stop - rows.start, width)
        color, alpha = _texels(diffuse, rows, shape, look.diffuse_rgba[:3])
        specular, glossiness = _texels(gloss, rows, shape, look.specular_rgb)
        linear, metallic = _converted(color, specular)
        base[rows, :, :3] = np.round(srgb_from_linear(linear) * 255).reshape(*shape, 3)
        base[rows, :, 3] = np.round(alpha * 255).reshape(shape)
        surface[rows, :, 1] = np.round((1.0 - look.glossiness * glossiness) * 255).reshape(shape)
        surface[rows, :, 2] = np.round(metallic * 255).reshape(shape)
    has_alpha = bool((base[..., 3] < 255).any())
    return _png(base if has_alpha else base[..., :3]), _png(surface)


def _texels(
    image: np.ndarray | None, rows: slice, shape: tuple[int, int], factor: tuple[float, ...]
) -> tuple[Float[np.ndarray, "texel 3"], Float[np.ndarray, " texel"]]:
    """Linear colour times `factor`, and the fourth channel (1 without an image)."""
    count = shape[0] * shape[1]
    if image is None:
        return np.broadcast_to(np.array(factor), (count, 3)), np.ones(count)
    values = image[rows].reshape(-1, 4) / 255.0
    return linear_from_srgb(values[:, :3]) * np.array(factor), values[:, 3]


def _png(pixels: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, format="PNG", compress_level=3)
    return buffer.getvalue()
