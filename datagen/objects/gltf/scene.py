"""glTF 2.0 scenes to one mesh: node transforms applied, materials as they are."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from datagen.objects.errors import ObjectError
from datagen.objects.files.texture_images import MAX_IMAGE_PX
from datagen.objects.gltf.container import MAX_FILE_MB, UNPACKING, GltfFile, damaged_gltf, open_gltf
from datagen.objects.gltf.draco import DRACO, DracoPrimitive, decoded_primitive
from datagen.objects.gltf.materials import WEBP, GltfMaterial, UvSource, read_material
from datagen.objects.gltf.motion import refuse_what_moves
from datagen.objects.gltf.nodes import INSTANCING, VISIBILITY, placed_meshes
from datagen.objects.mesh.file_mesh import FileMesh, refuse_too_many_faces
from datagen.objects.mesh.object_mesh import Material

__all__ = ["read_gltf"]

# What a file may require of its reader. What concerns textures and packed buffers is refused where
# such a texture or buffer has no plain copy; KHR_materials_* change no shape and no base colour.
IMPLEMENTED = (
    DRACO,
    *UNPACKING,
    WEBP,
    INSTANCING,
    VISIBILITY,
    "EXT_texture_avif",
    "KHR_mesh_quantization",
    "KHR_texture_basisu",
    "KHR_texture_transform",
    "MSFT_texture_dds",
)
ABOUT_MATERIALS = "KHR_materials_"
# These say nothing about what is drawn of the object in its own state.
HARMLESS = (
    "EXT_lights_image_based",
    "EXT_mesh_features",
    "EXT_structural_metadata",
    "KHR_animation_pointer",
    "KHR_lights_punctual",
    "KHR_node_hoverability",
    "KHR_node_selectability",
    "KHR_xmp",
    "KHR_xmp_json_ld",
    "MSFT_lod",
    "MSFT_packing_normalRoughnessMetallic",
    "MSFT_packing_occlusionRoughnessMetallic",
)

TRIANGLES, STRIP, FAN = 4, 5, 6
WIDTHS = {"POSITION": (3,), "COLOR_0": (3, 4)}  # components of a row; 2 for coordinates of textures
UNLIT_GREY = GltfMaterial(
    material=Material(name="unnamed", base_color_rgba=(1.0, 1.0, 1.0, 1.0), roughness=1.0),
    uv_sources=(UvSource(),),
)


@dataclass(frozen=True, kw_only=True)
class _Piece:
    """One primitive, in its node's frame or placed in the scene."""

    verts: Float[np.ndarray, "vert 3"]
    faces: Int[np.ndarray, "face 3"]
    uv_layers: tuple[Float[np.ndarray, "vert 2"], ...]  # at least one
    colors: Float[np.ndarray, "vert 3"] | None
    material: int


def read_gltf(
    path: Path,
    data: bytes,
    *,
    max_file_mb: float = MAX_FILE_MB,
    max_image_px: int = MAX_IMAGE_PX,
    max_faces: int | None = None,
) -> FileMesh:
    """All triangles of the default scene. Axes Y-up, metres (as the format says).

    `data` is the file's content; `path` finds files beside it (each up to `max_file_mb`) and names
    it in errors. Whatever is wrong with the file is an ObjectError. Images are as the file has them,
    except those of specular-gloss materials, which are converted (up to `max_image_px`).
    """
    try:
        file = open_gltf(path, data, max_file_mb=max_file_mb)
        return _scene_mesh(file, max_image_px, max_faces)
    except ObjectError:
        raise
    except LookupError as error:
        raise damaged_gltf(path, f"refers to something that is not there ({error!r})") from error
    except Exception as error:  # a value of a wrong type or size fails anywhere, as anything
        raise damaged_gltf(path, f"cannot be parsed ({error!r})") from error


def _scene_mesh(file: GltfFile, max_image_px: int, max_faces: int | None) -> FileMesh:
    _refuse_unknown_extensions(file)
    placed = placed_meshes(file)
    notes = list(refuse_what_moves(file, placed))
    listed = [read_material(file, entry, max_image_px) for entry in file.json.get("materials", [])]
    materials = (*listed, UNLIT_GREY)  # the last one is of primitives that name none
    pieces: dict[int, list[_Piece]] = {}
    n_faces = 0
    for mesh in placed:
        if mesh.mesh not in pieces:
            pieces[mesh.mesh] = list(_pieces(file, mesh.mesh, materials, notes))
        # A small file may place a large mesh many times: counted before it is copied.
        n_faces += sum(len(piece.faces) for piece in pieces[mesh.mesh]) * len(mesh.T_scene_from_instance)
        if max_faces is not None:
            refuse_too_many_faces(n_faces, file.path, max_faces)
    return _joined(
        [
            _placed(piece, T_scene_from_instance)
            for mesh in placed
            for T_scene_from_instance in mesh.T_scene_from_instance
            for piece in pieces[mesh.mesh]
        ],
        materials,
        notes,
    )


def _refuse_unknown_extensions(file: GltfFile) -> None:
    unknown = [
        name
        for name in map(str, file.json.get("extensionsRequired", []))
        if name not in IMPLEMENTED + HARMLESS and not name.startswith(ABOUT_MATERIALS)
    ]
    if unknown:
        raise ObjectError(
            file.path,
            f"requires {', '.join(unknown)}",
            expected="required extensions that are drawn here",
            action="Export it without, for instance with Blender.",
        )


def _pieces(
    file: GltfFile, mesh: int, materials: Sequence[GltfMaterial], notes: list[str]
) -> Iterator[_Piece]:
    """The primitives of a mesh that have faces; `notes` grows by what is left out."""
    primitives = file.entry("meshes", mesh)["primitives"]
    drawn = [p for p in primitives if p.get("mode", TRIANGLES) in (TRIANGLES, STRIP, FAN)]
    if len(drawn) < len(primitives):
        notes.append(f"{len(primitives) - len(drawn)} of {len(primitives)} primitives are points or lines")
    for primitive in drawn:
        yield _piece(file, primitive, materials, notes)


def _placed(piece: _Piece, T_scene_from_node: Float[np.ndarray, "4 4"]) -> _Piece:
    is_mirrored = np.linalg.det(T_scene_from_node[:3, :3]) < 0
    return replace(
        piece,
        verts=piece.verts @ T_scene_from_node[:3, :3].T + T_scene_from_node[:3, 3],
        faces=piece.faces[:, ::-1] if is_mirrored else piece.faces,
    )


def _piece(
    file: GltfFile, primitive: dict[str, Any], materials: Sequence[GltfMaterial], notes: list[str]
) -> _Piece:
    packed = decoded_primitive(file, primitive)
    verts = _attribute(file, primitive, packed, "POSITION")
    if verts is None:
        raise file.damaged("a primitive has no POSITION")
    faces = packed.faces if packed is not None else _plain_faces(file, primitive, len(verts))
    if not ((faces >= 0) & (faces < len(verts))).all():
        raise file.damaged("a face refers to a vertex that is not there")
    index = primitive.get("material", len(materials) - 1)
    if "material" in primitive:
        file.entry("materials", index)
    material = materials[index]
    colors = _attribute(file, primitive, packed, "COLOR_0")
    layers = []
    for source in material.uv_sources:
        uv = _attribute(file, primitive, packed, f"TEXCOORD_{source.tex_coord}")
        if uv is None and material.has_images:
            notes.append(
                f"material {material.material.name!r} has images and a primitive no TEXCOORD_{source.tex_coord}"
            )
        layers.append(
            np.zeros((len(verts), 2)) if uv is None else _upright(source.moved(uv.astype(np.float64)))
        )
    if any(len(column) != len(verts) for column in (*layers, colors) if column is not None):
        raise file.damaged("the attributes of a primitive differ in length")
    if not all(np.isfinite(uv[faces]).all() for uv in layers):
        if material.has_images:
            raise file.damaged("texture coordinates of a primitive are NaN or infinite")
        layers = [np.zeros_like(uv) for uv in layers]  # nothing is drawn by them
    return _Piece(
        verts=verts.astype(np.float64),
        faces=faces,
        uv_layers=tuple(layers),
        colors=None if colors is None else _color_factors(colors),
        material=index,
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


def _color_factors(colors: np.ndarray) -> Float[np.ndarray, "vert 3"]:
    """Linear RGB 0..1 of COLOR_0; integers are shares of the largest, also where a file forgets to say so."""
    largest = np.iinfo(colors.dtype).max if np.issubdtype(colors.dtype, np.integer) else 1
    return colors[:, :3].astype(np.float64) / largest


def _upright(uv: Float[np.ndarray, "vert 2"]) -> Float[np.ndarray, "vert 2"]:
    """With (0, 0) at the lower left, where glTF has the upper left."""
    return uv * [1.0, -1.0] + [0.0, 1.0]


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


def _joined(pieces: Sequence[_Piece], materials: Sequence[GltfMaterial], notes: Sequence[str]) -> FileMesh:
    offsets = np.cumsum([0, *(len(piece.verts) for piece in pieces)])
    used = sorted({piece.material for piece in pieces})
    n_layers = max((len(piece.uv_layers) for piece in pieces), default=1)
    uv_layers = [
        np.concatenate([np.zeros((0, 3, 2)), *(_corner_uv(piece, layer) for piece in pieces)])
        for layer in range(n_layers)
    ]
    is_tinted = any(piece.colors is not None for piece in pieces)
    of_materials = [note for index in used for note in materials[index].notes]
    return FileMesh(
        verts_file=np.concatenate([np.zeros((0, 3)), *(piece.verts for piece in pieces)]),
        faces=np.concatenate(
            [np.zeros((0, 3), np.int64), *(p.faces + o for p, o in zip(pieces, offsets))]
        ).astype(np.int64),
        corner_uv=uv_layers[0],
        face_material=np.concatenate(
            [np.zeros(0, np.int64), *(np.full(len(p.faces), used.index(p.material)) for p in pieces)]
        ).astype(np.int64),
        materials=tuple(materials[index].material for index in used),
        corner_colors=np.concatenate([_corner_colors(piece) for piece in pieces]) if is_tinted else None,
        more_corner_uv=tuple(uv_layers[1:]),
        notes=tuple(dict.fromkeys((*notes, *of_materials))),
    )


def _corner_uv(piece: _Piece, layer: int) -> Float[np.ndarray, "face 3 2"]:
    if layer < len(piece.uv_layers):
        return piece.uv_layers[layer][piece.faces]
    return np.zeros((len(piece.faces), 3, 2))  # no image of its material uses this layer


def _corner_colors(piece: _Piece) -> Float[np.ndarray, "face 3 3"]:
    return np.ones((len(piece.faces), 3, 3)) if piece.colors is None else piece.colors[piece.faces]
