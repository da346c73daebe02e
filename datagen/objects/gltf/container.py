"""The container of glTF 2.0: JSON, buffers, accessors, images. Nothing here knows of meshes."""

import base64
import json
import struct
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np

from datagen.objects.errors import ObjectError

__all__ = ["MAX_FILE_MB", "GltfFile", "damaged_gltf", "normalised", "open_gltf"]

# A million triangles as text (OBJ), or packed with several 8k images, take less.
MAX_FILE_MB = 200.0

DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
UNSIGNED = (5121, 5123, 5125)
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
SHOWN_CHARS = 200  # of what a file says, in messages


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
        self._is_glb = is_glb
        self._max_bytes = int(max_file_mb * 1e6)
        self._glb_chunk = glb_chunk
        self._buffers = [self._buffer(entry) for entry in document.get("buffers", [])]

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

    def _buffer(self, entry: dict[str, Any]) -> bytes:
        if "uri" in entry:
            return self._resource(entry["uri"], "buffer")
        if self._glb_chunk is None:
            raise self.damaged("a buffer has neither a uri nor a binary chunk")
        return self._glb_chunk

    def _resource(self, uri: str, kind: str) -> bytes:
        if uri.startswith("data:"):
            return self._inline(uri, kind)
        shown = uri[:SHOWN_CHARS]
        if self._is_glb:
            raise ObjectError(
                self.path,
                f"refers to the {kind} {shown!r} outside of it",
                expected="a .glb with everything inside",
                action="Export one .glb again, or a .gltf with its files beside it.",
            )
        if _leaves_folder(uri):
            raise ObjectError(
                self.path,
                f"refers to the {kind} {shown!r}",
                expected="files in its own folder or below",
                action="Put the file beside the .gltf and correct the uri, or export one .glb.",
            )
        path = self.path.parent / unquote(uri)
        if not path.is_file():
            raise ObjectError(
                self.path,
                f"{kind} {shown!r} is missing",
                expected=f"a file at {path}",
                action="Keep the files of a .gltf together, or export one .glb.",
            )
        if path.stat().st_size > self._max_bytes:
            raise ObjectError(
                self.path,
                f"its {kind} {shown!r} has {path.stat().st_size / 1e6:.0f} MB",
                expected=f"at most {self._max_bytes / 1e6:g} MB",
                action="Make the model smaller or raise `max_file_mb`.",
            )
        return path.read_bytes()

    def _inline(self, uri: str, kind: str) -> bytes:
        header, _, payload = uri.partition(",")
        try:
            if not header.endswith(";base64"):
                raise ValueError("not marked as base64")
            return base64.b64decode(unquote(payload))
        except ValueError as error:
            raise self.damaged(f"the data uri of a {kind} cannot be decoded ({error})") from error

    def view(self, index: int) -> bytes:
        """The bytes of one bufferView."""
        return self._view(index)[0]

    def _view(self, index: int) -> tuple[bytes, int]:
        view = self.entry("bufferViews", index)
        start, length = self._whole(view, "byteOffset", 0), self._whole(view, "byteLength")
        data = self._buffers[self._whole(view, "buffer")][start : start + length]
        if len(data) < length:
            raise self.damaged(f"bufferView {index} reaches beyond its buffer (file cut short?)")
        return data, self._whole(view, "byteStride", 0)

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
        """The encoded image file."""
        entry = self.entry("images", index)
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
    text, is_glb = data, data[:4] == b"glTF"
    if is_glb:
        text, chunk = _glb_chunks(path, data)
    try:
        document = json.loads(text)
        version = str(document["asset"]["version"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ObjectError(
            path,
            f"is not glTF ({error})",
            expected="a glTF 2.0 file",
            action="Check that the file is what its name says.",
        ) from error
    if not version.startswith("2"):
        raise ObjectError(path, f"is glTF {version}", expected="glTF 2.0", action="Convert it with Blender.")
    return GltfFile(path, document, chunk, max_file_mb, is_glb=is_glb)


def _leaves_folder(uri: str) -> bool:
    """Whether a uri is no plain path below the file's own folder (".." and backslashes included)."""
    parts = urlsplit(uri)
    path = PurePosixPath(unquote(uri).replace("\\", "/"))
    return bool(parts.scheme or parts.netloc) or path.is_absolute() or ".." in path.parts


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
