"""glTF 2.0 scenes to one mesh: node transforms applied, materials as they are."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from datagen.objects.errors import ObjectError
from datagen.objects.file_mesh import FileMesh
from datagen.objects.gltf_file import GltfFile, open_gltf
from datagen.objects.mesh import Material

__all__ = ["read_gltf"]

TRIANGLES, STRIP, FAN = 4, 5, 6
UNLIT_GREY = Material(name="unnamed", base_color_rgba=(1.0, 1.0, 1.0, 1.0), roughness=1.0)


@dataclass(frozen=True, kw_only=True)
class _Piece:
    """One primitive placed in the scene."""

    verts: Float[np.ndarray, "vert 3"]
    faces: Int[np.ndarray, "face 3"]
    uv: Float[np.ndarray, "vert 2"]
    colors: Float[np.ndarray, "vert 3"] | None
    material: int


def read_gltf(path: Path, data: bytes) -> FileMesh:
    """All triangles of the default scene. Axes Y-up, metres (as the format says).

    `data` is the file's content; `path` finds files beside it and names it in errors.
    """
    file = open_gltf(path, data)
    _refuse_what_moves_or_is_packed(file)
    materials = [_material(file, entry) for entry in file.json.get("materials", [])]
    try:
        pieces = [
            _piece(file, primitive, T_scene_from_node, len(materials))
            for mesh, T_scene_from_node in _placed_meshes(file)
            for primitive in file.json["meshes"][mesh]["primitives"]
            if primitive.get("mode", TRIANGLES) in (TRIANGLES, STRIP, FAN)
        ]
    except (KeyError, IndexError, TypeError) as error:
        raise file.damaged(f"refers to something that is not there ({error!r})") from error
    return _joined(pieces, (*materials, UNLIT_GREY))


def _refuse_what_moves_or_is_packed(file: GltfFile) -> None:
    packed = [
        name for name in file.json.get("extensionsRequired", []) if "draco" in name or "meshopt" in name
    ]
    if packed:
        raise ObjectError(
            file.path,
            f"is compressed with {', '.join(packed)}",
            expected="plain glTF buffers",
            action="Unpack it: `npx @gltf-transform/cli copy in.glb out.glb`.",
        )
    for key, what in (("skins", "is skinned"), ("animations", "is animated")):
        if file.json.get(key):
            raise ObjectError(
                file.path,
                f"{what} ({len(file.json[key])} {key})",
                expected="one rigid object",
                action="Apply the pose in Blender and export without animation.",
            )


def _node_matrix(node: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    T_parent_from_node = np.eye(4)
    T_parent_from_node[:3, :3] = rotation * np.array(node.get("scale", (1.0, 1.0, 1.0)))
    T_parent_from_node[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return T_parent_from_node


def _placed_meshes(file: GltfFile) -> list[tuple[int, Float[np.ndarray, "4 4"]]]:
    """(mesh, T_scene_from_node) of every node below the default scene, in file order."""
    nodes = file.json.get("nodes", [])
    scenes = file.json.get("scenes", [])
    children = {child for node in nodes for child in node.get("children", [])}
    roots = [index for index in range(len(nodes)) if index not in children]
    if scenes:
        roots = scenes[file.json.get("scene", 0)].get("nodes", [])
    placed, stack, visited = [], [(root, np.eye(4)) for root in reversed(roots)], 0
    while stack:
        index, T_scene_from_parent = stack.pop()
        visited += 1
        if visited > len(nodes):
            raise file.damaged("its node tree has a cycle")
        node = nodes[index]
        T_scene_from_node = T_scene_from_parent @ _node_matrix(node)
        if "mesh" in node:
            placed.append((node["mesh"], T_scene_from_node))
        stack.extend((child, T_scene_from_node) for child in reversed(node.get("children", [])))
    return placed


def _piece(
    file: GltfFile, primitive: dict[str, Any], T_scene_from_node: Float[np.ndarray, "4 4"], n_materials: int
) -> _Piece:
    attributes = primitive["attributes"]
    verts = file.accessor(attributes["POSITION"]).astype(np.float64)
    verts = verts @ T_scene_from_node[:3, :3].T + T_scene_from_node[:3, 3]
    index = (
        file.accessor(primitive["indices"])[:, 0].astype(np.int64)
        if "indices" in primitive
        else np.arange(len(verts))
    )
    faces = _triangles(index, primitive.get("mode", TRIANGLES))
    if len(faces) and (faces.max() >= len(verts)):
        raise file.damaged("a face refers to a vertex that is not there")
    if np.linalg.det(T_scene_from_node[:3, :3]) < 0:
        faces = faces[:, ::-1]
    material = primitive.get("material", n_materials)
    uv = np.zeros((len(verts), 2))
    uv_set = f"TEXCOORD_{_uv_set(file, material)}"
    if uv_set in attributes:
        uv = file.accessor(attributes[uv_set]).astype(np.float64)
        uv = _transformed_uv(file, material, uv)
        uv[:, 1] = 1.0 - uv[:, 1]
    colors = file.accessor(attributes["COLOR_0"])[:, :3] if "COLOR_0" in attributes else None
    if colors is not None:
        colors = colors.astype(np.float64)
    return _Piece(verts=verts, faces=faces, uv=uv, colors=colors, material=material)


def _triangles(index: Int[np.ndarray, "corner"], mode: int) -> Int[np.ndarray, "face 3"]:
    if mode == TRIANGLES:
        return index[: len(index) // 3 * 3].reshape(-1, 3)
    if mode == STRIP:
        faces = np.stack([index[:-2], index[1:-1], index[2:]], axis=1)
        faces[1::2] = faces[1::2, [1, 0, 2]]
        return faces
    return np.stack([np.full(len(index) - 2, index[0]), index[1:-1], index[2:]], axis=1)


def _base_color_info(file: GltfFile, material: int) -> dict[str, Any]:
    materials = file.json.get("materials", [])
    if material >= len(materials):
        return {}
    return materials[material].get("pbrMetallicRoughness", {}).get("baseColorTexture", {})


def _uv_set(file: GltfFile, material: int) -> int:
    info = _base_color_info(file, material)
    moved = info.get("extensions", {}).get("KHR_texture_transform", {})
    return moved.get("texCoord", info.get("texCoord", 0))


def _transformed_uv(
    file: GltfFile, material: int, uv: Float[np.ndarray, "vert 2"]
) -> Float[np.ndarray, "vert 2"]:
    """KHR_texture_transform of the base colour, applied to the coordinates themselves."""
    moved = _base_color_info(file, material).get("extensions", {}).get("KHR_texture_transform")
    if not moved:
        return uv
    angle = moved.get("rotation", 0.0)
    rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return (uv * moved.get("scale", (1.0, 1.0))) @ rotation.T + moved.get("offset", (0.0, 0.0))


def _texture(file: GltfFile, info: dict[str, Any] | None) -> bytes | None:
    if info is None:
        return None
    texture = file.json["textures"][info["index"]]
    source = (
        texture.get("extensions", {}).get("EXT_texture_webp", texture).get("source", texture.get("source"))
    )
    return None if source is None else file.image(source)


def _material(file: GltfFile, entry: dict[str, Any]) -> Material:
    pbr = entry.get("pbrMetallicRoughness", {})
    extensions = entry.get("extensions", {})
    strength = extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
    return Material(
        name=entry.get("name", "unnamed"),
        base_color_rgba=tuple(map(float, pbr.get("baseColorFactor", (1, 1, 1, 1)))),  # type: ignore[arg-type]
        base_color_image=_texture(file, pbr.get("baseColorTexture")),
        metallic=float(pbr.get("metallicFactor", 1)),
        roughness=float(pbr.get("roughnessFactor", 1)),
        metallic_roughness_image=_texture(file, pbr.get("metallicRoughnessTexture")),
        normal_image=_texture(file, entry.get("normalTexture")),
        emissive_rgb=tuple(float(strength * value) for value in entry.get("emissiveFactor", (0, 0, 0))),  # type: ignore[arg-type]
        emissive_image=_texture(file, entry.get("emissiveTexture")),
        transmission=float(extensions.get("KHR_materials_transmission", {}).get("transmissionFactor", 0)),
        ior=float(extensions.get("KHR_materials_ior", {}).get("ior", 1.45)),
    )


def _joined(pieces: list[_Piece], materials: tuple[Material, ...]) -> FileMesh:
    offsets = np.cumsum([0, *(len(piece.verts) for piece in pieces)])
    colored = bool(pieces) and all(piece.colors is not None for piece in pieces)
    used = sorted({piece.material for piece in pieces})
    return FileMesh(
        verts_file=np.concatenate([np.zeros((0, 3)), *(piece.verts for piece in pieces)]),
        faces=np.concatenate(
            [np.zeros((0, 3), np.int64), *(p.faces + o for p, o in zip(pieces, offsets))]
        ).astype(np.int64),
        corner_uv=np.concatenate([np.zeros((0, 3, 2)), *(piece.uv[piece.faces] for piece in pieces)]),
        face_material=np.concatenate(
            [np.zeros(0, np.int64), *(np.full(len(p.faces), used.index(p.material)) for p in pieces)]
        ).astype(np.int64),
        materials=tuple(materials[index] for index in used),
        corner_colors=(
            np.concatenate([p.colors[p.faces] for p in pieces if p.colors is not None]) if colored else None
        ),
    )
