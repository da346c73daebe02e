"""The three images of a frame: colour, masks (one PNG of bits) and geometry (OpenEXR).

Everything happens in memory, and the same pixels always give the same bytes.
"""

import importlib
import io
from dataclasses import dataclass
from typing import Literal

import numpy as np
import OpenEXR

from shards.array_types import Bool, Float, UInt8
from shards.errors import ImageError
from shards.storage.png import decode_png, encode_png

__all__ = [
    "MASK_BITS",
    "DepthCompression",
    "Geometry",
    "Masks",
    "decode_geometry",
    "decode_masks",
    "decode_rgb",
    "encode_geometry",
    "encode_masks",
    "encode_rgb_png",
    "mask_box_px",
]

DepthCompression = Literal["pxr24", "zip"]
_COMPRESSION = {"pxr24": OpenEXR.PXR24_COMPRESSION, "zip": OpenEXR.ZIP_COMPRESSION}


@dataclass(frozen=True, kw_only=True, eq=False)
class Masks:
    """Who is seen at each pixel centre (visible), and who would be without the others (amodal)."""

    hand_visible: Bool[np.ndarray, "height width"]
    object_visible: Bool[np.ndarray, "height width"]
    hand_amodal: Bool[np.ndarray, "height width"]
    object_amodal: Bool[np.ndarray, "height width"]
    arm_visible: Bool[np.ndarray, "height width"]  # forearm and sleeve
    arm_amodal: Bool[np.ndarray, "height width"]


MASK_BITS = {
    "hand_visible": 1,
    "object_visible": 2,
    "hand_amodal": 4,
    "object_amodal": 8,
    "arm_visible": 16,
    "arm_amodal": 32,
}
_ALL_BITS = sum(MASK_BITS.values())


@dataclass(frozen=True, kw_only=True, eq=False)
class Geometry:
    """Exact surfaces at pixel centres; 0 where there is nothing.

    `depth`: z of the first surface of the whole scene. `depth_object`: z of the object alone, as if
    nothing were in front of it. `normals_cam`: outward unit normals of the first surface.
    """

    depth: Float[np.ndarray, "height width"]  # metres
    depth_object: Float[np.ndarray, "height width"]  # metres
    normals_cam: Float[np.ndarray, "height width 3"]


def encode_rgb_png(rgb: UInt8[np.ndarray, "height width 3"]) -> bytes:
    """Lossless sRGB image; every reader of shards can decode it."""
    return encode_png(rgb)


def decode_rgb(data: bytes) -> UInt8[np.ndarray, "height width 3"]:
    """sRGB pixels of a PNG; of a JPEG or WebP when Pillow is installed. Raises ImageError."""
    pixels = decode_png(data) if data[:4] == b"\x89PNG" else _decode_with_pillow(data)
    if pixels.ndim != 3 or pixels.shape[2] != 3:
        raise ImageError("not an RGB image", expected="(height, width, 3)", found=pixels.shape)
    return pixels


def encode_masks(bits: UInt8[np.ndarray, "height width"]) -> bytes:
    """8-bit gray PNG of MASK_BITS, one byte per pixel."""
    if bits.ndim != 2 or bits.max() > _ALL_BITS:
        raise ImageError("not a mask image", expected=f"(height, width), 0..{_ALL_BITS}", found=bits.shape)
    return encode_png(bits, level=9)


def decode_masks(data: bytes) -> Masks:
    """The six masks. Raises ImageError."""
    bits = decode_png(data)
    if bits.ndim != 2 or bits.max() > _ALL_BITS:
        raise ImageError(
            "not a mask image", expected=f"gray, 0..{_ALL_BITS}", found=f"{bits.shape}, {bits.max()}"
        )
    return Masks(**{name: (bits & bit) != 0 for name, bit in MASK_BITS.items()})


def mask_box_px(mask: Bool[np.ndarray, "height width"]) -> tuple[int, int, int, int]:
    """Tight box (x0, y0, x1, y1) around the true pixels, in pixel edges; -1 four times when empty."""
    x, y = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    if len(x) == 0:
        return (-1, -1, -1, -1)
    return (int(x[0]), int(y[0]), int(x[-1]) + 1, int(y[-1]) + 1)


def encode_geometry(
    depth: Float[np.ndarray, "height width"],
    depth_object: Float[np.ndarray, "height width"],
    normals_cam: Float[np.ndarray, "height width 3"],
    *,
    compression: DepthCompression,
) -> bytes:
    """OpenEXR bytes of what `Geometry` describes.

    Depths are float32: "pxr24" keeps 24 bits of each (relative error at most 2^-16), "zip" all of them.
    Normals are half floats either way.
    """
    channels = {
        "Z": np.ascontiguousarray(depth, np.float32),
        "object.Z": np.ascontiguousarray(depth_object, np.float32),
        **{
            f"N.{axis}": np.ascontiguousarray(normals_cam[..., i], np.float16) for i, axis in enumerate("XYZ")
        },
    }
    header = {"compression": _COMPRESSION[compression], "type": OpenEXR.scanlineimage}
    stream = io.BytesIO()
    with OpenEXR.File(header, channels) as file:
        file.write(stream)
    return stream.getvalue()


def decode_geometry(data: bytes) -> Geometry:
    """Depths and normals, float32. Raises ImageError."""
    try:
        with OpenEXR.File(io.BytesIO(data), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, OSError, MemoryError) as error:
        raise ImageError(f"damaged OpenEXR image: {error}") from error
    wanted = ("Z", "object.Z", "N.X", "N.Y", "N.Z")
    missing = [name for name in wanted if name not in channels]
    if missing:
        raise ImageError("OpenEXR image without its channels", expected=wanted, found=sorted(channels))
    return Geometry(
        depth=channels["Z"],
        depth_object=channels["object.Z"],
        normals_cam=np.stack([channels[f"N.{axis}"] for axis in "XYZ"], axis=-1).astype(np.float32),
    )


def _decode_with_pillow(data: bytes) -> UInt8[np.ndarray, "height width 3"]:
    try:
        pillow = importlib.import_module("PIL.Image")
    except ImportError as error:
        fix = "pip install pillow, or use a data set whose clips.rgb_codec is png"
        raise ImageError("JPEG and WebP images need Pillow", found=data[:4], fix=fix) from error
    try:
        with pillow.open(io.BytesIO(data)) as image:
            return np.asarray(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError) as error:
        raise ImageError(f"damaged image: {error}") from error
