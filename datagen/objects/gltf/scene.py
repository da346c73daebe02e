"""glTF 2.0 scenes to one mesh: node transforms applied, materials as they are."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from datagen.objects.errors import ObjectError
from datagen.objects.gltf.container import MAX_FILE_MB, GltfFile, damaged_gltf, open_gltf
from datagen.objects.gltf.draco import DRACO, DracoPrimitive, decoded_primitive
from datagen.objects.gltf.materials import SPECULAR_GLOSS, UNLIT, WEBP, read_material, transformed_uv, uv_set
from datagen.objects.mesh.file_mesh import FileMesh
from datagen.objects.mesh.object_mesh import Material

__all__ = ["read_gltf"]

# What a file may require of its reader; anything else would be drawn wrongly.
IMPLEMENTED = (
    DRACO,
    WEBP,
    SPECULAR_GLOSS,
    UNLIT,
    "KHR_materials_emissive_strength",
    "KHR_materials_ior",
    "KHR_materials_transmission",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
)

TRIANGLES, STRIP, FAN = 4, 5, 6
WIDTHS = {"POSITION": (3,), "COLOR_0": (3, 4)}  # components of a row; 2 for coordinates of textures
UNLIT_GREY = Material(name="unnamed", base_color_rgba=(1.0, 1.0, 1.0, 1.0), roughness=1.0)


@dataclass(frozen=True, kw_only=True)
class _Piece:
    """One primitive placed in the scene."""

    verts: Float[np.ndarray, "vert 3"]
    faces: Int[np.ndarray, "face 3"]
    uv: Float[np.ndarray, "vert 2"]
    colors: Float[np.ndarray, "vert 3"] | None
    material: int


def read_gltf(path: Path, data: bytes, *, max_file_mb: float = MAX_FILE_MB) -> FileMesh:
    """All triangles of the default scene. Axes Y-up, metres (as the format says).

    `data` is the file's content; `path` finds files beside it (each up to `max_file_mb`) and names
    it in errors. Whatever is wrong with the file is an ObjectError.
    """
    try:
        return _scene_mesh(open_gltf(path, data, max_file_mb=max_file_mb))
    except ObjectError:
        raise
    except LookupError as error:
        raise damaged_gltf(path, f"refers to something that is not there ({error!r})") from error
    except Exception as error:  # a value of a wrong type or size fails anywhere, as anything
        raise damaged_gltf(path, f"cannot be parsed ({error!r})") from error


def _scene_mesh(file: GltfFile) -> FileMesh:
    _refuse_unknown_extensions(file)
    _refuse_what_moves(file)
    listed = [read_material(file, entry) for entry in file.json.get("materials", [])]
    materials = (*listed, UNLIT_GREY)  # the last one is of primitives that name none
    pieces = [
        _piece(file, primitive, T_scene_from_node, materials)
        for mesh, T_scene_from_node in _placed_meshes(file)
        for primitive in file.entry("meshes", mesh)["primitives"]
        if primitive.get("mode", TRIANGLES) in (TRIANGLES, STRIP, FAN)
    ]
    return _joined(pieces, materials)


def _refuse_unknown_extensions(file: GltfFile) -> None:
    unknown = [name for name in file.json.get("extensionsRequired", []) if name not in IMPLEMENTED]
    if unknown:
        raise ObjectError(
            file.path,
            f"requires {', '.join(map(str, unknown))}",
            expected=f"no other required extensions than {', '.join(IMPLEMENTED)}",
            action="Convert it: `npx @gltf-transform/cli copy in.glb out.glb`, or Blender.",
        )


def _refuse_what_moves(file: GltfFile) -> None:
    """Skins, animations and shapes that morph targets deform are no rigid objects."""
    channels = [channel for entry in file.json.get("animations", []) for channel in entry.get("channels", [])]
    morphing = any(channel.get("target", {}).get("path") == "weights" for channel in channels)
    carriers = [*file.json.get("meshes", []), *file.json.get("nodes", [])]
    n_morphed = sum(any(entry.get("weights", [])) for entry in carriers)
    for key, what in (
        ("skins", "is skinned"),
        ("animations", "animates morph targets" if morphing else "is animated"),
    ):
        if file.json.get(key):
            raise _moving(file, f"{what} ({len(file.json[key])} {key})")
    if n_morphed:
        raise _moving(file, f"is deformed by morph targets ({n_morphed} with weights)")


def _moving(file: GltfFile, problem: str) -> ObjectError:
    return ObjectError(
        file.path,
        problem,
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
        roots = file.entry("scenes", file.json.get("scene", 0)).get("nodes", [])
    placed, stack, visited = [], [(root, np.eye(4)) for root in reversed(roots)], 0
    while stack:
        index, T_scene_from_parent = stack.pop()
        visited += 1
        if visited > len(nodes):
            raise file.damaged("its node tree has a cycle")
        node = file.entry("nodes", index)
        T_scene_from_node = T_scene_from_parent @ _node_matrix(node)
        if "mesh" in node:
            placed.append((node["mesh"], T_scene_from_node))
        stack.extend((child, T_scene_from_node) for child in reversed(node.get("children", [])))
    return placed


def _piece(
    file: GltfFile,
    primitive: dict[str, Any],
    T_scene_from_node: Float[np.ndarray, "4 4"],
    materials: tuple[Material, ...],
) -> _Piece:
    packed = decoded_primitive(file, primitive)
    positions = _attribute(file, primitive, packed, "POSITION")
    if positions is None:
        raise file.damaged("a primitive has no POSITION")
    verts = positions.astype(np.float64) @ T_scene_from_node[:3, :3].T + T_scene_from_node[:3, 3]
    faces = packed.faces if packed is not None else _plain_faces(file, primitive, len(verts))
    if not ((faces >= 0) & (faces < len(verts))).all():
        raise file.damaged("a face refers to a vertex that is not there")
    if np.linalg.det(T_scene_from_node[:3, :3]) < 0:
        faces = faces[:, ::-1]
    material = primitive.get("material", len(materials) - 1)
    if "material" in primitive:
        file.entry("materials", material)
    uv = _attribute(file, primitive, packed, uv_set(file, material))
    colors = _attribute(file, primitive, packed, "COLOR_0")
    if any(len(column) != len(verts) for column in (uv, colors) if column is not None):
        raise file.damaged("the attributes of a primitive differ in length")
    uv = np.zeros((len(verts), 2)) if uv is None else _upright_uv(file, material, uv)
    if not np.isfinite(uv[faces]).all():
        if materials[material].base_color_image is not None:
            raise file.damaged("texture coordinates of a primitive are NaN or infinite")
        uv = np.zeros_like(uv)  # nothing is drawn by them
    return _Piece(
        verts=verts,
        faces=faces,
        uv=uv,
        colors=None if colors is None else colors[:, :3].astype(np.float64),
        material=material,
    )


def _attribute(
    file: GltfFile, primitive: dict[str, Any], packed: DracoPrimitive | None, name: str
) -> np.ndarray | None:
    """Rows of one attribute; None where the primitive has none of this name."""
    if packed is not None and name in packed.attributes:
        found = packed.attributes[name]
    elif name in primitive["attributes"]:
        found = file.accessor(primitive["attributes"][name])
    else:
        return None
    if found.ndim != 2 or found.shape[1] not in WIDTHS.get(name, (2,)):
        raise file.damaged(f"{name} of a primitive has the shape {found.shape}")
    return found


def _upright_uv(
    file: GltfFile, material: int, uv: Float[np.ndarray, "vert 2"]
) -> Float[np.ndarray, "vert 2"]:
    """With (0, 0) at the lower left, where glTF has the upper left."""
    return transformed_uv(file, material, uv.astype(np.float64)) * [1.0, -1.0] + [0.0, 1.0]


def _plain_faces(file: GltfFile, primitive: dict[str, Any], n_verts: int) -> Int[np.ndarray, "face 3"]:
    index = np.arange(n_verts)
    if "indices" in primitive:
        index = file.accessor(primitive["indices"])[:, 0].astype(np.int64)
    return _triangles(index, primitive.get("mode", TRIANGLES))


def _triangles(index: Int[np.ndarray, " corner"], mode: int) -> Int[np.ndarray, "face 3"]:
    if mode == TRIANGLES:
        return index[: len(index) // 3 * 3].reshape(-1, 3)
    if mode == STRIP:
        faces = np.stack([index[:-2], index[1:-1], index[2:]], axis=1)
        faces[1::2] = faces[1::2, [1, 0, 2]]
        return faces
    return np.stack([np.full(len(index) - 2, index[0]), index[1:-1], index[2:]], axis=1)


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
