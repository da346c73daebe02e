"""The container of glTF 2.0: JSON, buffers, accessors, images. Nothing here knows of meshes."""

import base64
import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from datagen.objects.errors import ObjectError

__all__ = ["MAX_FILE_MB", "GltfFile", "normalised", "open_gltf"]

# A million triangles as text (OBJ), or packed with several 8k images, take less.
MAX_FILE_MB = 200.0

DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class GltfFile:
    """An opened file: `json` plus typed access to its binary parts."""

    def __init__(
        self, path: Path, document: dict[str, Any], glb_chunk: bytes | None, max_file_mb: float
    ) -> None:
        self.path = path
        self.json = document
        self._max_file_mb = max_file_mb
        self._glb_chunk = glb_chunk
        self._buffers = [self._buffer(entry) for entry in document.get("buffers", [])]

    def damaged(self, what: str) -> ObjectError:
        """The error for a file that contradicts itself."""
        return ObjectError(
            self.path, what, expected="a valid glTF 2.0 file", action="Export it again or download it anew."
        )

    def _buffer(self, entry: dict[str, Any]) -> bytes:
        if "uri" in entry:
            return self._resource(entry["uri"], "buffer")
        if self._glb_chunk is None:
            raise self.damaged("a buffer has neither a uri nor a binary chunk")
        return self._glb_chunk

    def _resource(self, uri: str, kind: str) -> bytes:
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        path = self.path.parent / unquote(uri)
        if not path.is_file():
            raise ObjectError(
                self.path,
                f"{kind} {uri!r} is missing",
                expected=f"a file at {path}",
                action="Keep the files of a .gltf together, or export one .glb.",
            )
        if path.stat().st_size > self._max_file_mb * 1e6:
            raise ObjectError(
                self.path,
                f"its {kind} {uri!r} has {path.stat().st_size / 1e6:.0f} MB",
                expected=f"at most {self._max_file_mb:g} MB",
                action="Make the model smaller or raise `max_file_mb`.",
            )
        return path.read_bytes()

    def view(self, index: int) -> bytes:
        """The bytes of one bufferView."""
        return self._view(index)[0]

    def _view(self, index: int) -> tuple[bytes, int]:
        view = self.json["bufferViews"][index]
        start = view.get("byteOffset", 0)
        data = self._buffers[view["buffer"]][start : start + view["byteLength"]]
        if len(data) < view["byteLength"]:
            raise self.damaged(f"bufferView {index} reaches beyond its buffer (file cut short?)")
        return data, view.get("byteStride", 0)

    def accessor(self, index: int) -> np.ndarray:
        """Rows of one accessor: floats where it is float or normalised, else its integers."""
        entry = self.json["accessors"][index]
        dtype, width, count = np.dtype(DTYPES[entry["componentType"]]), WIDTHS[entry["type"]], entry["count"]
        rows = np.zeros((count, width), dtype=dtype)
        if "bufferView" in entry:
            rows = self._rows(entry["bufferView"], entry.get("byteOffset", 0), dtype, count, width)
        if "sparse" in entry:
            rows = self._with_sparse(rows.copy(), entry["sparse"])
        return normalised(rows, entry)

    def _rows(self, view: int, offset: int, dtype: np.dtype, count: int, width: int) -> np.ndarray:
        data, stride = self._view(view)
        row_bytes = dtype.itemsize * width
        stride = stride or row_bytes
        if count and offset + stride * (count - 1) + row_bytes > len(data):
            raise self.damaged(f"an accessor reaches beyond bufferView {view}")
        flat = np.frombuffer(data, dtype=np.uint8)[offset:]
        rows = np.lib.stride_tricks.as_strided(flat, (count, row_bytes), (stride, 1))
        return np.ascontiguousarray(rows).view(dtype).reshape(count, width)

    def _with_sparse(self, rows: np.ndarray, sparse: dict[str, Any]) -> np.ndarray:
        where, values = sparse["indices"], sparse["values"]
        index_dtype = np.dtype(DTYPES[where["componentType"]])
        count = sparse["count"]
        index = self._rows(where["bufferView"], where.get("byteOffset", 0), index_dtype, count, 1)[:, 0]
        width = rows.shape[1]
        rows[index] = self._rows(values["bufferView"], values.get("byteOffset", 0), rows.dtype, count, width)
        return rows

    def image(self, index: int) -> bytes:
        """The encoded image file."""
        entry = self.json["images"][index]
        if "uri" in entry:
            return self._resource(entry["uri"], "texture")
        return self.view(entry["bufferView"])


def normalised(rows: np.ndarray, accessor: dict[str, Any]) -> np.ndarray:
    """Integers of a normalised accessor as 0..1 or -1..1 (glTF 2.0, 3.11); others unchanged."""
    if not accessor.get("normalized"):
        return rows
    largest = np.iinfo(np.dtype(DTYPES[accessor["componentType"]])).max
    return np.maximum(rows.astype(np.float64) / largest, -1.0)


def open_gltf(path: Path, data: bytes, *, max_file_mb: float = MAX_FILE_MB) -> GltfFile:
    """The content of a .glb or .gltf file (`path` is for messages and for files beside it)."""
    chunk: bytes | None = None
    text = data
    if data[:4] == b"glTF":
        text, chunk = _glb_chunks(path, data)
    try:
        document = json.loads(text)
        version = str(document["asset"]["version"])
    except (ValueError, KeyError, TypeError) as error:
        raise ObjectError(
            path,
            f"is not glTF ({error})",
            expected="a glTF 2.0 file",
            action="Check that the file is what its name says.",
        ) from error
    if not version.startswith("2"):
        raise ObjectError(path, f"is glTF {version}", expected="glTF 2.0", action="Convert it with Blender.")
    return GltfFile(path, document, chunk, max_file_mb)


def _glb_chunks(path: Path, data: bytes) -> tuple[bytes, bytes | None]:
    offset = 12
    chunks: dict[bytes, bytes] = {}
    while offset + 8 <= len(data):
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
    return chunks.get(b"JSON", b""), chunks.get(b"BIN\0")
