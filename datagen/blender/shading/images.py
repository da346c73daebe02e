"""Encoded images to Blender textures, checked before Cycles can paint them pink."""

import io

import bpy
import numpy as np
from jaxtyping import Float32
from PIL import Image

__all__ = ["MAX_TEXTURE_PX", "TextureError", "add_drawn_image", "add_image", "coded_normals", "decode_image"]

# A hand-held object covers at most a frame; larger textures cost memory and no pixel shows it.
MAX_TEXTURE_PX = 2048
_BLENDER_MODES = ("L", "RGB", "RGBA", "P")


class TextureError(ValueError):
    """An image of the scene cannot be decoded."""


def decode_image(data: bytes, what: str) -> Image.Image:
    """Decode a PNG or JPEG completely. Raises TextureError naming `what`."""
    try:
        image = Image.open(io.BytesIO(data), formats=("PNG", "JPEG"))
        image.load()
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise TextureError(f"{what}: not a readable image ({error}); replace the file") from error
    return image


def add_image(data: bytes, what: str, *, is_color: bool) -> bpy.types.Image:
    """A packed Blender image; colour images are sRGB, the others plain numbers.

    Images beyond MAX_TEXTURE_PX are reduced. Raises TextureError when `data` is damaged.
    """
    decoded = decode_image(data, what)
    if max(decoded.size) > MAX_TEXTURE_PX or decoded.mode not in _BLENDER_MODES:
        decoded = decoded.convert("RGBA" if "A" in decoded.getbands() else "RGB")
        decoded.thumbnail((MAX_TEXTURE_PX, MAX_TEXTURE_PX), Image.Resampling.LANCZOS)
        buffer = io.BytesIO()
        decoded.save(buffer, "PNG", compress_level=1)
        data = buffer.getvalue()
    image = bpy.data.images.new(what, 1, 1)
    image.pack(data=data, data_len=len(data))
    image.source = "FILE"
    image.colorspace_settings.name = "sRGB" if is_color else "Non-Color"
    image.alpha_mode = "CHANNEL_PACKED"
    if tuple(image.size) != decoded.size:
        raise TextureError(
            f"{what}: not a readable image (Blender reads {tuple(image.size)} pixels of {decoded.size}); "
            "replace the file"
        )
    return image


def add_drawn_image(
    name: str, pixels: Float32[np.ndarray, "row column channel"], *, is_color: bool
) -> bpy.types.Image:
    """An 8-bit image from 3 or 4 channels in 0..1, lowest row first; colour images are sRGB-coded."""
    height, width, channels = pixels.shape
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :channels] = pixels
    image = bpy.data.images.new(name, width, height, alpha=True, is_data=not is_color)
    image.alpha_mode = "CHANNEL_PACKED"
    image.pixels.foreach_set(rgba.reshape(-1))
    image.update()
    return image


def coded_normals(
    height_m: Float32[np.ndarray, "row column"], texel_m: float
) -> Float32[np.ndarray, "row column 3"]:
    """Tangent-space normals of a relief, coded 0..1; lowest row first, as `add_drawn_image` takes it."""
    slope_y, slope_x = np.gradient(height_m, texel_m)
    length = np.sqrt(1.0 + slope_x**2 + slope_y**2)
    return (
        0.5 + 0.5 * np.stack([-slope_x, -slope_y, np.ones_like(length)], axis=-1) / length[..., None]
    ).astype(np.float32)
