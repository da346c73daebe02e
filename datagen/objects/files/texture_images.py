"""Texture files of any common kind as the PNG or JPEG that glTF permits.

What every decoder shows alike keeps its bytes. The rest (other containers, CMYK, 16-bit grey, which
decoders clip or cannot read) becomes an 8-bit PNG of the same colours. Orientation tags and colour
profiles of PNG and JPEG are ignored, as glTF demands (FORMATS 10.1).
"""

import io

import numpy as np
from PIL import Image

from datagen.objects.errors import ObjectError

__all__ = ["MAX_IMAGE_PX", "TEXTURE_FORMATS", "decoded_rgba", "has_alpha", "permitted_image"]

MAX_IMAGE_PX = 8192  # of a side: 256 MiB decoded
# Tried in this order; TGA has no signature and comes last. Nothing here runs a program (as EPS would).
TEXTURE_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "GIF", "TIFF", "TGA")
READ_HERE = "PNG, JPEG, WebP, BMP, TGA, GIF or TIFF"
KEPT_FORMATS = ("PNG", "JPEG", "MPO")  # MPO: a JPEG that others follow
KEPT_MODES = ("1", "L", "LA", "P", "RGB", "RGBA")
SIXTEEN_BIT = ("I;16", "I;16L", "I;16B", "I;16N")
# Kinds that are met in the field and not read here: place and bytes of their signatures.
NAMED_ONLY = (
    (0, b"\xabKTX", "KTX"),
    (0, b"DDS ", "DDS"),
    (0, b"8BPS", "PSD"),
    (0, b"\x76\x2f\x31\x01", "OpenEXR"),
    (0, b"#?R", "Radiance HDR"),
    (0, b"%!PS", "PostScript"),
    (0, b"<svg", "SVG"),
    (0, b"<?xml", "SVG"),
    (4, b"ftypavi", "AVIF"),
    (4, b"ftyphei", "HEIC"),
    (4, b"jP  ", "JPEG 2000"),
    (4, b"JXL ", "JPEG XL"),
    (0, b"\xff\x0a", "JPEG XL"),
)


def permitted_image(data: bytes, source: object, what: str, max_px: int) -> bytes:
    """`data` itself where glTF permits it as it is, else a PNG of it (the first frame of several).

    ObjectError names `source` and `what` ("the base colour of material 'x'") where the file is
    damaged, of a kind that is not read here, or has a side above `max_px`, before it is decoded.
    """
    try:
        opened = Image.open(io.BytesIO(data), formats=TEXTURE_FORMATS)
        if max(opened.size) <= max_px:
            opened.load()
            kept = opened.format in KEPT_FORMATS and opened.mode in KEPT_MODES
            return data if kept else _png(_eight_bit(opened))
        shown = f"{opened.width}x{opened.height}"
    except Image.DecompressionBombError:
        shown = f"larger than {2 * (Image.MAX_IMAGE_PIXELS or 0):,} pixels"
    except Exception as error:  # Pillow raises whatever its decoders raise
        kind = _kind(data)
        raise ObjectError(
            source,
            f"{what} is {kind}" if kind else f"{what} cannot be decoded ({_reason(error)})",
            expected=READ_HERE,
            action="Convert the image to PNG." if kind else "Save the image again.",
        ) from error
    raise ObjectError(
        source,
        f"{what} is {shown}",
        expected=f"sides of at most {max_px} px",
        action="Scale the image down or raise `max_image_px`.",
    )


def decoded_rgba(data: bytes) -> Image.Image:
    """What `permitted_image` gave, decoded as RGBA."""
    return Image.open(io.BytesIO(data), formats=TEXTURE_FORMATS).convert("RGBA")


def has_alpha(data: bytes) -> bool:
    """Whether an image has a channel or a colour for transparency; False where it cannot be opened."""
    try:
        return _shows_through(Image.open(io.BytesIO(data), formats=TEXTURE_FORMATS))
    except Exception:  # Pillow raises whatever its decoders raise; `permitted_image` says what is wrong
        return False


def _shows_through(image: Image.Image) -> bool:
    return "A" in image.mode.upper() or "transparency" in image.info


def _eight_bit(image: Image.Image) -> Image.Image:
    if image.mode in SIXTEEN_BIT or (image.mode, image.format) == ("I", "PNG"):  # "I" before Pillow 11
        return Image.fromarray(np.round(np.asarray(image) / 257.0).astype(np.uint8))
    if image.mode in ("I", "F"):
        raise ValueError("32-bit samples, whose white is not defined")
    if image.mode in KEPT_MODES and "transparency" not in image.info:
        return image
    return image.convert("RGBA" if _shows_through(image) else "RGB")


def _png(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, format="PNG", compress_level=3)
    return buffer.getvalue()


def _kind(data: bytes) -> str | None:
    return next((name for at, start, name in NAMED_ONLY if data.startswith(start, at)), None)


def _reason(error: Exception) -> str:
    """Without the address of a buffer, which Pillow writes into its message."""
    return "not an image" if "cannot identify image file" in str(error) else str(error)
