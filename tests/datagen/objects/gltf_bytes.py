"""glTF files made part by part, as strangers write them."""

import json
import struct
from typing import Any

import numpy as np

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype="<f4")  # metres, Y up
SQUARE_UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], dtype="<f4")  # the whole image, upright
SQUARE_FACES = np.array([0, 1, 2, 0, 2, 3], dtype="<u2")
COMPONENTS = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


class GltfBytes:
    """`json` may be changed before `glb` packs it; one node draws mesh 0 unless `nodes` is replaced."""

    def __init__(self, **document: Any) -> None:
        self.binary = b""
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": []}],
            "accessors": [],
            "bufferViews": [],
            **document,
        }

    def view(self, data: bytes, **more: Any) -> int:
        entry = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data), **more}
        self.binary += data + b"\0" * (-len(data) % 4)
        self.json["bufferViews"].append(entry)
        return len(self.json["bufferViews"]) - 1

    def accessor(self, rows: np.ndarray, **more: Any) -> int:
        """Rows as they are, four bytes aligned as vertex attributes must be."""
        rows = rows.reshape(len(rows), -1)
        entry = {
            "componentType": COMPONENTS[rows.dtype.name],
            "count": len(rows),
            "type": KINDS[rows.shape[1]],
            **more,
        }
        pad, stride = -rows.itemsize * rows.shape[1] % 4, {}
        if pad and rows.shape[1] > 1:
            padded = np.zeros((len(rows), rows.itemsize * rows.shape[1] + pad), np.uint8)
            padded[:, :-pad] = np.ascontiguousarray(rows).view(np.uint8)
            rows, stride = padded, {"byteStride": padded.shape[1]}
        entry["bufferView"] = self.view(rows.tobytes(), **stride)
        self.json["accessors"].append(entry)
        return len(self.json["accessors"]) - 1

    def texture(self, image: bytes, mime: str = "image/png", **sampler: int) -> int:
        """Index of a texture that shows an image file."""
        images, textures = (self.json.setdefault(kind, []) for kind in ("images", "textures"))
        images.append({"bufferView": self.view(image), "mimeType": mime})
        textures.append({"source": len(images) - 1})
        if sampler:
            samplers = self.json.setdefault("samplers", [])
            samplers.append(sampler)
            textures[-1]["sampler"] = len(samplers) - 1
        return len(textures) - 1

    def material(self, **entry: Any) -> int:
        self.json.setdefault("materials", []).append(entry)
        return len(self.json["materials"]) - 1

    def square(self, *, offset: tuple[float, float, float] = (0, 0, 0), **primitive: Any) -> dict[str, Any]:
        """A primitive of mesh 0: a square of 1 m with UVs; COLOR_0 and so on are added to its attributes."""
        entry: dict[str, Any] = {
            "attributes": {
                "POSITION": self.accessor((SQUARE + np.array(offset)).astype("<f4")),
                "TEXCOORD_0": self.accessor(SQUARE_UV),
            },
            "indices": self.accessor(SQUARE_FACES),
            **primitive,
        }
        self.json["meshes"][0]["primitives"].append(entry)
        return entry

    def glb(self) -> bytes:
        document = {**self.json, "buffers": [{"byteLength": len(self.binary)}]}
        return glb_of(json.dumps(document).encode(), self.binary)


def glb_of(text: bytes, binary: bytes = b"", padding: bytes = b" ") -> bytes:
    text += padding * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
