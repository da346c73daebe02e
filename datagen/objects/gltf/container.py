"""The container of glTF 2.0: JSON, buffers, accessors, images. Nothing here knows of meshes."""

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from datagen.objects.errors import ObjectError
from datagen.objects.gltf.resources import SHOWN_CHARS, Resources

__all__ = ["MAX_FILE_MB", "UNPACKING", "GltfFile", "damaged_gltf", "normalised", "open_gltf"]

# A million triangles as text (OBJ), or packed with several 8k images, take less.
MAX_FILE_MB = 200.0

DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
UNSIGNED = (5121, 5123, 5125)
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
SMALLEST_GLB = 20  # bytes of the header and of a chunk's
# Extensions that pack bufferViews, and what unpacks them.
UNPACKING = {
    "EXT_meshopt_compression": "npx @gltf-transform/cli copy in.glb out.glb",
    "KHR_meshopt_compression": "npx gltfpack -i in.glb -o out.glb -noq",
}


def damaged_gltf(path: Path, what: str) -> ObjectError:
    """The error for a file that contradicts itself or the format."""
    shown = what if len(what) <= SHOWN_CHARS else f"{what[:SHOWN_CHARS]}..."
    return ObjectError(
        path, shown, expected="a valid glTF 2.0 file", action="Export it again or download it anew."
    )


class GltfFile:
    """An opened file: `json` plus typed access to its binary parts.

    Nothing in the file is trusted: sizes and places are checked before they are read or allocated.
    """

    def __init__(
        self,
        path: Path,
        document: dict[str, Any],
        glb_chunk: bytes | None,
        max_file_mb: float,
        *,
        is_glb: bool,
    ) -> None:
        self.path = path
        self.json = document
        self._max_bytes = int(max_file_mb * 1e6)
        self._resources = Resources(path=path, is_glb=is_glb, max_bytes=self._max_bytes)
        self._images: dict[int, bytes] = {}
        self._buffers = [
            self._stated_buffer(index, entry, glb_chunk)
            for index, entry in enumerate(document.get("buffers", []))
        ]

    def _stated_buffer(self, index: int, entry: dict[str, Any], glb_chunk: bytes | None) -> bytes | None:
        """The bytes of one buffer; None where it has none, which only matters where they are wanted."""
        if "uri" not in entry:
            return glb_chunk if index == 0 else None
        if not any(entry.get("extensions", {}).get(name, {}).get("fallback") for name in UNPACKING):
            return self._resources.read(entry["uri"], "buffer")
        try:  # gltfpack puts the plain copy beside a .glb too, and people leave it behind
            return replace(self._resources, is_glb=False).read(entry["uri"], "buffer")
        except ObjectError:
            return None

    def damaged(self, what: str) -> ObjectError:
        """The error for a file that contradicts itself."""
        return damaged_gltf(self.path, what)

    def entry(self, kind: str, index: object) -> dict[str, Any]:
        """The `index`-th of the document's list `kind`, such as "accessors"; never counted from the end."""
        if type(index) is not int or index < 0:
            raise self.damaged(f"refers to {kind}[{index!r}]")
        return self.json[kind][index]

    def _whole(self, entry: dict[str, Any], key: str, default: int | None = None) -> int:
        value = entry.get(key, default)
        if type(value) is not int or value < 0:
            raise self.damaged(f"a {key} is {value!r} instead of a whole number from 0")
        return value

    def view(self, index: int) -> bytes:
        """The bytes of one bufferView."""
        return self._view(index)[0]

    def _view(self, index: int) -> tuple[bytes, int]:
        view = self.entry("bufferViews", index)
        start, length = self._whole(view, "byteOffset", 0), self._whole(view, "byteLength")
        data = self._buffer(view)[start : start + length]
        if len(data) < length:
            raise self.damaged(f"bufferView {index} reaches beyond its buffer (file cut short?)")
        return data, self._whole(view, "byteStride", 0)

    def _buffer(self, view: dict[str, Any]) -> bytes:
        """What a bufferView is cut from; of packed ones the plain copy, if there is one (FORMATS 10.3)."""
        data = self._buffers[self._whole(view, "buffer")]
        if data is not None:
            return data
        packing = next((name for name in UNPACKING if name in view.get("extensions", {})), None)
        if packing is None:
            raise self.damaged("a buffer has neither a uri nor a binary chunk")
        raise ObjectError(
            self.path,
            f"is packed with {packing}, without a plain copy",
            expected="plain or Draco-compressed glTF 2.0",
            action=f"Unpack it: `{UNPACKING[packing]}`.",
        )

    def accessor(self, index: int) -> np.ndarray:
        """Rows of one accessor: floats where it is float or normalised, else its integers."""
        entry = self.entry("accessors", index)
        dtype, width = np.dtype(DTYPES[entry["componentType"]]), WIDTHS[entry["type"]]
        count = self._whole(entry, "count")
        if "bufferView" in entry:
            rows = self._rows(entry["bufferView"], self._whole(entry, "byteOffset", 0), dtype, count, width)
        elif count * width * dtype.itemsize > self._max_bytes:
            raise self.damaged(f"accessor {index} has {count:,} rows and no bufferView")
        else:
            rows = np.zeros((count, width), dtype=dtype)
        if "sparse" in entry:
            rows = self._with_sparse(rows.copy(), entry["sparse"])
        return normalised(rows, entry)

    def _rows(self, view: int, offset: int, dtype: np.dtype, count: int, width: int) -> np.ndarray:
        data, stride = self._view(view)
        row_bytes = dtype.itemsize * width
        stride = stride or row_bytes
        if stride < row_bytes:
            raise self.damaged(
                f"bufferView {view} has a byteStride of {stride} for rows of {row_bytes} bytes"
            )
        if count and offset + stride * (count - 1) + row_bytes > len(data):
            raise self.damaged(f"an accessor reaches beyond bufferView {view}")
        flat = np.frombuffer(data, dtype=np.uint8)[offset:]
        rows = np.lib.stride_tricks.as_strided(flat, (count, row_bytes), (stride, 1))
        return np.ascontiguousarray(rows).view(dtype).reshape(count, width)

    def _with_sparse(self, rows: np.ndarray, sparse: dict[str, Any]) -> np.ndarray:
        where, values = sparse["indices"], sparse["values"]
        if where["componentType"] not in UNSIGNED:
            raise self.damaged(f"sparse indices have componentType {where['componentType']!r}")
        index_dtype, count = np.dtype(DTYPES[where["componentType"]]), self._whole(sparse, "count")
        at = self._whole(where, "byteOffset", 0), self._whole(values, "byteOffset", 0)
        index = self._rows(where["bufferView"], at[0], index_dtype, count, 1)[:, 0]
        rows[index] = self._rows(values["bufferView"], at[1], rows.dtype, count, rows.shape[1])
        return rows

    def image(self, index: int) -> bytes:
        """The encoded image file; the same object each time."""
        entry = self.entry("images", index)
        if index not in self._images:
            uri = entry.get("uri")
            self._images[index] = (
                self.view(entry["bufferView"]) if uri is None else self._resources.read(uri, "texture")
            )
        return self._images[index]


def normalised(rows: np.ndarray, accessor: dict[str, Any]) -> np.ndarray:
    """Integers of a normalised accessor as 0..1 or -1..1 (glTF 2.0, 3.11); others unchanged."""
    if not accessor.get("normalized"):
        return rows
    largest = np.iinfo(np.dtype(DTYPES[accessor["componentType"]])).max
    return np.maximum(rows.astype(np.float64) / largest, -1.0)


def open_gltf(path: Path, data: bytes, *, max_file_mb: float = MAX_FILE_MB) -> GltfFile:
    """The content of a .glb or .gltf file (`path` is for messages and for files beside it)."""
    chunk: bytes | None = None
    text, is_glb = data, data[:4] == b"glTF"
    if is_glb:
        text, chunk = _glb_chunks(path, data)
    return GltfFile(path, _document(path, text), chunk, max_file_mb, is_glb=is_glb)


def _document(path: Path, text: bytes) -> dict[str, Any]:
    """The JSON part. Encodings with a byte order mark are read; letters that are none become signs."""
    try:
        document = json.loads(text.decode(json.detect_encoding(text), errors="replace"))
        # Collections were dictionaries by name in glTF 1.0, lists since.
        is_first = any(isinstance(document.get(kind), dict) for kind in ("buffers", "meshes", "nodes"))
        version = "1.0" if is_first else str(document["asset"]["version"])
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ObjectError(
            path,
            f"is not glTF ({error})",
            expected="a glTF 2.0 file",
            action="Check that the file is what its name says.",
        ) from error
    if not version.startswith("2"):
        raise _old_version(path, version)
    return document


def _old_version(path: Path, version: str) -> ObjectError:
    return ObjectError(
        path,
        f"is glTF {version}",
        expected="glTF 2.0",
        action="Convert it: `npx gltf-pipeline -i old.gltf -o new.glb` (a .glb in place of the .gltf will do).",
    )


def _glb_chunks(path: Path, data: bytes) -> tuple[bytes, bytes | None]:
    if len(data) >= 12 and data[4:8] == b"\1\0\0\0":
        raise _old_version(path, "1.0")
    stated = int.from_bytes(data[8:12], "little")
    # What follows the stated length is not of the file; some writers state too little.
    end = stated if SMALLEST_GLB <= stated <= len(data) else len(data)
    offset = 12
    chunks: dict[bytes, bytes] = {}
    while offset + 8 <= end:
        length, kind = struct.unpack_from("<I4s", data, offset)
        chunk = data[offset + 8 : offset + 8 + length]
        if len(chunk) < length:
            raise ObjectError(
                path,
                f"is cut short ({len(data)} bytes)",
                expected=f"at least {offset + 8 + length} bytes",
                action="Download or copy the file again.",
            )
        chunks.setdefault(kind, chunk)
        offset += 8 + length
    # Spaces are the padding that the format wants; some writers fill up with zeros.
    return chunks.get(b"JSON", b"").rstrip(b"\0 \t\r\n"), chunks.get(b"BIN\0")
