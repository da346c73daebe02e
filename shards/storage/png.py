"""PNG with NumPy and zlib alone: 8-bit gray, RGB and RGBA, not interlaced.

The same pixels always give the same bytes (for one zlib), and the checksum of every chunk is
verified on reading. Format: https://www.w3.org/TR/png-3/.
"""

import struct
import zlib

import numpy as np

from shards.array_types import UInt8
from shards.errors import ImageError

__all__ = ["decode_png", "encode_png"]

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3, 6: 4}  # PNG colour type -> channels
_COLOR_TYPE = {channels: color_type for color_type, channels in _CHANNELS.items()}
_NONE, _SUB, _UP, _AVERAGE, _PAETH = range(5)
_MAX_PIXELS = 1 << 28  # refuses a damaged header before memory is taken


def encode_png(image: UInt8[np.ndarray, "height width *channels"], *, level: int = 6) -> bytes:
    """PNG bytes of a gray (height, width) or RGB(A) (height, width, 3|4) image.

    One filter for the whole image: the best of None, Sub and Up by the usual estimate (smallest
    sum of absolute signed residuals), None for label images, where zlib alone does better.
    """
    pixels = np.asarray(image)
    channels = pixels.shape[2] if pixels.ndim == 3 else 1
    if (
        pixels.dtype != np.uint8
        or pixels.ndim not in (2, 3)
        or channels not in _COLOR_TYPE
        or pixels.size == 0
    ):
        found = f"{pixels.dtype} {pixels.shape}"
        raise ImageError(
            "cannot be a PNG", expected="uint8 (height, width) or (height, width, 3|4)", found=found
        )
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels).reshape(height, width * channels)
    filter_type, filtered = _best_filter(rows, channels)
    lines = np.empty((height, 1 + width * channels), np.uint8)
    lines[:, 0] = filter_type
    lines[:, 1:] = filtered
    header = struct.pack(">IIBBBBB", width, height, 8, _COLOR_TYPE[channels], 0, 0, 0)
    data = zlib.compress(lines.tobytes(), level)
    return _SIGNATURE + _chunk(b"IHDR", header) + _chunk(b"IDAT", data) + _chunk(b"IEND", b"")


def decode_png(data: bytes) -> UInt8[np.ndarray, "height width *channels"]:
    """Pixels of any not interlaced 8-bit gray, RGB or RGBA PNG. Raises ImageError."""
    if data[:8] != _SIGNATURE:
        raise ImageError("not a PNG", expected=_SIGNATURE, found=data[:8])
    width, height, channels, compressed = _parse_chunks(data)
    stride = width * channels
    n_bytes = height * (stride + 1)
    try:
        raw = zlib.decompressobj().decompress(compressed, n_bytes + 1)
    except zlib.error as error:
        raise ImageError(f"damaged PNG: {error}") from error
    if len(raw) != n_bytes:
        raise ImageError("damaged PNG: wrong amount of pixels", expected=n_bytes, found=len(raw))
    lines = np.frombuffer(raw, np.uint8).reshape(height, stride + 1)
    filters, residuals = lines[:, 0], lines[:, 1:]
    if filters.max() > _PAETH:
        raise ImageError("damaged PNG: unknown filter", expected="0..4", found=int(filters.max()))
    if filters.max() <= _UP:
        pixels = _undo_simple_filters(filters, residuals, channels)
    else:
        pixels = _undo_any_filters(filters, residuals.reshape(height, width, channels))
    return pixels.reshape((height, width) if channels == 1 else (height, width, channels))


def _best_filter(
    rows: UInt8[np.ndarray, "height stride"], channels: int
) -> tuple[int, UInt8[np.ndarray, "height stride"]]:
    if channels == 1 and np.count_nonzero(np.bincount(rows.reshape(-1), minlength=256)) <= 64:
        return _NONE, rows
    sub = rows.copy()
    sub[:, channels:] -= rows[:, :-channels]
    up = rows.copy()
    up[1:] -= rows[:-1]
    candidates = ((_NONE, rows), (_SUB, sub), (_UP, up))
    return min(
        candidates, key=lambda candidate: int(np.abs(candidate[1].view(np.int8).astype(np.int16)).sum())
    )


def _parse_chunks(data: bytes) -> tuple[int, int, int, bytes]:
    """(width, height, channels, joined IDAT data)."""
    header, parts, position = None, [], 8
    while True:
        if position + 12 > len(data):
            raise ImageError("truncated PNG")
        (length,) = struct.unpack_from(">I", data, position)
        kind, body = data[position + 4 : position + 8], data[position + 8 : position + 8 + length]
        stored_crc = data[position + 8 + length : position + 12 + length]
        if len(stored_crc) < 4 or zlib.crc32(kind + body) != int.from_bytes(stored_crc, "big"):
            raise ImageError("damaged PNG: a chunk does not match its checksum", found=kind)
        position += 12 + length
        if kind == b"IHDR" and length == 13:
            header = struct.unpack(">IIBBBBB", body)
        elif kind == b"IDAT":
            parts.append(body)
        elif kind == b"IEND":
            break
    if header is None:
        raise ImageError("damaged PNG: no header")
    width, height, depth, color_type, compression, filtering, interlace = header
    if (depth, compression, filtering, interlace) != (8, 0, 0, 0) or color_type not in _CHANNELS:
        found = f"bit depth {depth}, colour type {color_type}, interlace {interlace}"
        raise ImageError("unsupported PNG", expected="8-bit gray, RGB or RGBA, not interlaced", found=found)
    if not 0 < width * height <= _MAX_PIXELS:
        raise ImageError("unsupported PNG size", found=f"{width} x {height}")
    return width, height, _CHANNELS[color_type], b"".join(parts)


def _undo_simple_filters(
    filters: UInt8[np.ndarray, " height"], residuals: UInt8[np.ndarray, "height stride"], channels: int
) -> UInt8[np.ndarray, "height stride"]:
    """None, Sub and Up: sums along the row, or of whole rows."""
    pixels = residuals.copy()
    sub = np.flatnonzero(filters == _SUB)
    if len(sub):
        stride = residuals.shape[1]
        by_channel = residuals[sub].reshape(len(sub), stride // channels, channels)
        pixels[sub] = np.add.accumulate(by_channel, axis=1, dtype=np.uint8).reshape(len(sub), stride)
    for row in np.flatnonzero(filters == _UP):
        if row > 0:
            pixels[row] += pixels[row - 1]
    return pixels


def _undo_any_filters(
    filters: UInt8[np.ndarray, " height"], residuals: UInt8[np.ndarray, "height width channels"]
) -> UInt8[np.ndarray, "height width channels"]:
    """All five filters, one anti-diagonal at a time.

    A pixel needs its left, upper and upper-left neighbours, so all pixels with the same x + y
    can be computed together: width + height vector steps instead of a loop over pixels.
    In the skewed array below, entry [x + y + 2, y + 1] is pixel (x, y); the border is 0.
    """
    height, width, channels = residuals.shape
    skewed = np.zeros((height + width + 1, height + 1, channels), np.int16)
    kind = np.concatenate([[_NONE], filters])[:, None]
    is_sub, is_up, is_average, is_paeth = (kind == f for f in (_SUB, _UP, _AVERAGE, _PAETH))
    for diagonal in range(height + width - 1):
        low, high = max(0, diagonal - width + 1), min(height, diagonal + 1)
        y = np.arange(low, high)
        rows = slice(low + 1, high + 1)
        left, above = skewed[diagonal + 1, rows], skewed[diagonal + 1, low:high]
        corner = skewed[diagonal, low:high]
        to_left, to_above = np.abs(above - corner), np.abs(left - corner)
        to_corner = np.abs(left + above - 2 * corner)
        nearest = np.where(to_above <= to_corner, above, corner)
        paeth = np.where((to_left <= to_above) & (to_left <= to_corner), left, nearest)
        predicted = left * is_sub[rows] + above * is_up[rows]
        predicted += ((left + above) >> 1) * is_average[rows] + paeth * is_paeth[rows]
        skewed[diagonal + 2, rows] = (residuals[y, diagonal - y] + predicted) & 255
    y, x = np.mgrid[:height, :width]
    return skewed[x + y + 2, y + 1].astype(np.uint8)


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
