"""PNG files as Blender writes them, checked and without the times Cycles notes in them."""

import struct
import zlib
from pathlib import Path

from datagen.blender.log import RenderError
from shards.storage.whole_file import write_whole

__all__ = ["finish_image"]

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_KEPT = (b"IHDR", b"IDAT", b"IEND")


def finish_image(partial: Path, final: Path) -> None:
    """Check a written image, drop its metadata and give it its name, in one step.

    Render times in the file would make equal images differ. Raises RenderError when the file
    is not a whole PNG (a disk that filled up leaves one that stops early).
    """
    kept = _kept_chunks(partial.read_bytes() if partial.is_file() else b"")
    if kept is None:
        raise RenderError(f"{partial}: Blender wrote no complete image; is the disk full?")
    with write_whole(final) as stripped:
        stripped.write_bytes(kept)
    partial.unlink()


def _kept_chunks(data: bytes) -> bytes | None:
    """The file without ancillary chunks; None when it is not a whole PNG."""
    if not data.startswith(_SIGNATURE):
        return None
    kept, position, kind = [_SIGNATURE], len(_SIGNATURE), b""
    while kind != b"IEND":
        if position + 12 > len(data):
            return None
        length, kind = struct.unpack_from(">I4s", data, position)
        chunk = data[position : position + length + 12]
        if len(chunk) < length + 12 or zlib.crc32(chunk[4:-4]) != struct.unpack(">I", chunk[-4:])[0]:
            return None
        if kind in _KEPT:
            kept.append(chunk)
        position += len(chunk)
    return b"".join(kept)
