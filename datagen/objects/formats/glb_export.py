"""ObjectMesh to GLB: one self-contained, valid file; equal meshes give equal bytes."""

import json
import struct
from typing import Any

import numpy as np
from jaxtyping import Float

from datagen.objects.formats.reading import ROTATION_FROM_Y_UP
from datagen.objects.mesh.object_mesh import ImageLayout, Material, ObjectMesh
from datagen.objects.mesh.surface_points import face_normals
from shards.texture_wrap import WRAPS, Wrap

__all__ = ["corner_normals", "mesh_to_glb"]

FLOAT, UINT32, UINT16 = 5126, 5125, 5123
ARRAY_BUFFER, ELEMENT_BUFFER = 34962, 34963
WRAP_CODES = {wrap: code for code, wrap in WRAPS.items()}
PNG_SIGNATURE = b"\x89PNG"
AUTO_SMOOTH_RAD = np.deg2rad(40.0)


class _Writer:
    """The JSON document and the binary chunk as they grow."""

    def __init__(self) -> None:
        self.binary = bytearray()
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "forehoi-open"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": []}],
            "materials": [],
            "accessors": [],
            "bufferViews": [],
        }
        self._image_ids: dict[bytes, int] = {}
        self._texture_ids: dict[tuple[int, Wrap, Wrap], int] = {}

    def view(self, data: bytes, target: int | None = None) -> int:
        self.binary.extend(b"\0" * (-len(self.binary) % 4))
        entry: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)}
        if target is not None:
            entry["target"] = target
        self.binary.extend(data)
        self.json["bufferViews"].append(entry)
        return len(self.json["bufferViews"]) - 1

    def accessor(self, rows: np.ndarray, component: int, kind: str, *, bounds: bool = False) -> int:
        target = ELEMENT_BUFFER if kind == "SCALAR" else ARRAY_BUFFER
        entry: dict[str, Any] = {
            "bufferView": self.view(np.ascontiguousarray(rows).tobytes(), target),
            "componentType": component,
            "count": len(rows),
            "type": kind,
        }
        if bounds:
            entry["min"] = [float(value) for value in rows.min(axis=0)]
            entry["max"] = [float(value) for value in rows.max(axis=0)]
        self.json["accessors"].append(entry)
        return len(self.json["accessors"]) - 1

    def texture(self, image: bytes | None, layout: ImageLayout) -> dict[str, int] | None:
        """A textureInfo; glTF's defaults (repeating, TEXCOORD_0) are not written."""
        if image is None:
            return None
        if image not in self._image_ids:
            kind = "image/png" if image.startswith(PNG_SIGNATURE) else "image/jpeg"
            images = self.json.setdefault("images", [])
            images.append({"bufferView": self.view(image), "mimeType": kind})
            self._image_ids[image] = len(images) - 1
        key = self._image_ids[image], layout.wrap_u, layout.wrap_v
        if key not in self._texture_ids:
            textures, entry = self.json.setdefault("textures", []), {"source": key[0]}
            if key[1:] != ("repeat", "repeat"):
                entry["sampler"] = self._sampler(layout)
            textures.append(entry)
            self._texture_ids[key] = len(textures) - 1
        info = {"index": self._texture_ids[key]}
        return info | ({"texCoord": layout.uv_layer} if layout.uv_layer else {})

    def _sampler(self, layout: ImageLayout) -> int:
        samplers = self.json.setdefault("samplers", [])
        entry = {"wrapS": WRAP_CODES[layout.wrap_u], "wrapT": WRAP_CODES[layout.wrap_v]}
        if entry not in samplers:
            samplers.append(entry)
        return samplers.index(entry)

    def bytes(self) -> bytes:
        self.binary.extend(b"\0" * (-len(self.binary) % 4))
        self.json["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(self.json, separators=(",", ":"), sort_keys=True).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + len(self.binary)
        return b"".join(
            (
                struct.pack("<4sII", b"glTF", 2, total),
                struct.pack("<I4s", len(text), b"JSON"),
                text,
                struct.pack("<I4s", len(self.binary), b"BIN\0"),
                bytes(self.binary),
            )
        )


def mesh_to_glb(mesh: ObjectMesh, *, normals: bool = True) -> bytes:
    """GLB 2.0 in metres, Y-up as the format wants; images are embedded as they are.

    Corner colours become COLOR_0 of the materials that they tint, further UVs TEXCOORD_1 and so on.
    `normals=False` leaves shading normals out (a quarter smaller; viewers then shade flat).
    """
    writer = _Writer()
    verts = mesh.verts_obj @ ROTATION_FROM_Y_UP  # rows: transpose of the Z-up from Y-up turn
    shading = corner_normals(mesh) @ ROTATION_FROM_Y_UP if normals else None
    for index, material in enumerate(mesh.materials):
        chosen = mesh.face_material == index
        if not chosen.any():
            continue
        columns = {"POSITION": verts[mesh.faces[chosen]], "TEXCOORD_0": mesh.corner_uv[chosen]}
        if shading is not None:
            columns["NORMAL"] = shading[chosen]
        for layer in range(1, _n_uv_layers(material)):
            columns[f"TEXCOORD_{layer}"] = mesh.more_corner_uv[layer - 1][chosen]
        if mesh.corner_colors is not None and (mesh.corner_colors[chosen] != 1.0).any():
            columns["COLOR_0"] = mesh.corner_colors[chosen]
        writer.json["meshes"][0]["primitives"].append(
            _primitive(writer, columns, len(writer.json["materials"]))
        )
        writer.json["materials"].append(_material_json(writer, material))
    extensions = sorted({name for entry in writer.json["materials"] for name in entry.get("extensions", {})})
    if extensions:
        writer.json["extensionsUsed"] = extensions
    return writer.bytes()


def _n_uv_layers(material: Material) -> int:
    """Of the images that the material has; TEXCOORD_n must be numbered without gaps."""
    layouts = (
        (material.base_color_image, material.base_color_layout),
        (material.metallic_roughness_image, material.metallic_roughness_layout),
        (material.normal_image, material.normal_layout),
        (material.emissive_image, material.emissive_layout),
    )
    return 1 + max((layout.uv_layer for image, layout in layouts if image is not None), default=0)


def _primitive(writer: _Writer, columns: dict[str, np.ndarray], material: int) -> dict[str, Any]:
    """Of corner `columns` ("face 3 column"), written in their order; equal corners become one vertex."""
    widths = [rows.shape[2] for rows in columns.values()]
    corners = np.concatenate([rows.reshape(-1, rows.shape[2]) for rows in columns.values()], axis=1)
    corners = corners.astype("<f4") + np.float32(0.0)  # no -0.0
    unique, inverse = np.unique(corners, axis=0, return_inverse=True)
    attributes = {}
    for name, rows in zip(columns, np.split(unique, np.cumsum(widths)[:-1], axis=1)):
        if name.startswith("TEXCOORD"):
            rows = np.stack([rows[:, 0], 1.0 - rows[:, 1]], axis=1)  # (0, 0) is the upper left there
        kind = f"VEC{rows.shape[1]}"
        attributes[name] = writer.accessor(rows, FLOAT, kind, bounds=name == "POSITION")
    small = len(unique) < 65536
    index = inverse.reshape(-1).astype("<u2" if small else "<u4")
    indices = writer.accessor(index, UINT16 if small else UINT32, "SCALAR")
    return {"attributes": attributes, "indices": indices, "material": material}


def _material_json(writer: _Writer, material: Material) -> dict[str, Any]:
    pbr: dict[str, Any] = {
        "baseColorFactor": list(material.base_color_rgba),
        "baseColorTexture": writer.texture(material.base_color_image, material.base_color_layout),
        "metallicFactor": material.metallic,
        "roughnessFactor": material.roughness,
        "metallicRoughnessTexture": writer.texture(
            material.metallic_roughness_image, material.metallic_roughness_layout
        ),
    }
    strength = max(1.0, *material.emissive_rgb)
    entry: dict[str, Any] = {
        "name": material.name,
        "pbrMetallicRoughness": {key: value for key, value in pbr.items() if value is not None},
        "normalTexture": writer.texture(material.normal_image, material.normal_layout),
        "emissiveFactor": [value / strength for value in material.emissive_rgb],
        "emissiveTexture": writer.texture(material.emissive_image, material.emissive_layout),
        "doubleSided": True,
    }
    extensions: dict[str, Any] = {"KHR_materials_ior": {"ior": material.ior}}
    if material.transmission > 0:
        extensions["KHR_materials_transmission"] = {"transmissionFactor": material.transmission}
    if strength > 1:
        extensions["KHR_materials_emissive_strength"] = {"emissiveStrength": strength}
    entry["extensions"] = extensions
    return {key: value for key, value in entry.items() if value is not None}


def corner_normals(mesh: ObjectMesh) -> Float[np.ndarray, "face 3 3"]:
    """Shading normals: area-weighted over the faces around a vertex that lie within 40 degrees."""
    flat = face_normals(mesh.verts_obj, mesh.faces)
    if not mesh.smooth:
        return np.repeat(flat[:, None], 3, axis=1)
    a, b, c = (mesh.verts_obj[mesh.faces[:, k]] for k in range(3))
    weighted = np.cross(b - a, c - a)
    order = np.argsort(mesh.faces.reshape(-1), kind="stable")
    valence = np.bincount(mesh.faces.reshape(-1), minlength=len(mesh.verts_obj))
    starts = np.concatenate([[0], np.cumsum(valence)])
    corner_vertex = mesh.faces.reshape(-1)
    counts = valence[corner_vertex]
    corner = np.repeat(np.arange(len(corner_vertex)), counts)
    within = np.arange(len(corner)) - np.repeat(np.cumsum(counts) - counts, counts)
    neighbour = order[starts[corner_vertex[corner]] + within] // 3
    close = (flat[corner // 3] * flat[neighbour]).sum(axis=1) >= np.cos(AUTO_SMOOTH_RAD)
    total = np.stack(
        [np.bincount(corner, weighted[neighbour, k] * close, len(corner_vertex)) for k in range(3)], axis=1
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    total = np.divide(total, length, out=np.repeat(flat, 3, axis=0), where=length > 0)
    return total.reshape(-1, 3, 3)
