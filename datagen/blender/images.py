"""Encoded images to Blender textures, checked before Cycles can paint them pink."""

import io

import bpy
from PIL import Image

__all__ = ["MAX_TEXTURE_PX", "TextureError", "add_image", "decode_image"]

# A hand-held object covers at most a frame; larger textures cost memory and no pixel shows it.
MAX_TEXTURE_PX = 2048
_BLENDER_MODES = ("L", "RGB", "RGBA", "P")


class TextureError(ValueError):
    """An image of the scene cannot be decoded."""


def decode_image(data: bytes, what: str) -> Image.Image:
    """Decode a PNG or JPEG completely. Raises TextureError naming `what`."""
    try:
        image = Image.open(io.BytesIO(data))
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
        raise TextureError(f"{what}: Blender reads {tuple(image.size)} pixels of {decoded.size}; save it as PNG")
    return image
