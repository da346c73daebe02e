"""The textured meshes of the shards' objects, in the canonical frame.

Read of a GLB, as `datagen` writes them: base colours (factors, images, vertex colours), UVs and normals. Base colour
factors keep 8 bits (trimesh); everything is opaque and nothing shines. What glows is the colour of the surface where it
is brighter, as in `surface_colors`; not beside vertex colours, or where its image lies otherwise than the base's.
"""

import io
import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Float32, Int32, UInt8
from PIL import Image

from model.errors import ModelError
from model.surface.export import ROTATION_YUP_FROM_OBJ
from shards.color import linear_from_srgb, srgb_from_linear
from shards.errors import DatasetNotFoundError
from shards.reader import Shard
from shards.texture_wrap import WRAPS, Wrap

__all__ = ["MeshRecord", "ObjectMeshes", "TexturedMesh", "textured_mesh"]

_WHITE = np.full((1, 1, 3), 255, dtype=np.uint8)


@dataclass(frozen=True, kw_only=True, eq=False)
class TexturedMesh:
    """Triangles that may be open, may intersect and are seen from both sides; canonical frame."""

    vertices: Float32[np.ndarray, "vertex 3"]
    normals: Float32[np.ndarray, "vertex 3"]  # unit, for shading
    uv: Float32[np.ndarray, "vertex 2"]  # (0, 0) is the lower left of the image
    colors: Float32[np.ndarray, "vertex 3"]  # linear light, 0..1; times the texture
    faces: Int32[np.ndarray, "face 3"]
    face_texture: Int32[np.ndarray, " face"]  # index into `textures`
    textures: tuple[UInt8[np.ndarray, "_ _ 3"], ...]  # sRGB; white where a material has none
    wraps: tuple[tuple[Wrap, Wrap], ...]  # of each texture beyond its borders, along u and v


def textured_mesh(
    glb: bytes, T_objmesh_from_canonical: Float[np.ndarray, "4 4"], *, where: str
) -> TexturedMesh:
    """The mesh of a shard (binary glTF, Y up, metres). ModelError, naming `where`, when it cannot be read."""
    try:
        named, document = _with_numbered_materials(glb)
        scene = trimesh.load_scene(io.BytesIO(named), file_type="glb", process=False)
        parts = [_part(scene, node, document) for node in scene.graph.nodes_geometry]
    # trimesh has no error of its own: broken files raise whatever the reading stumbles over.
    except Exception as error:
        raise _unreadable(where, " ".join(str(error).split())[:200] or type(error).__name__) from error
    parts = [part for part in parts if len(part.faces)]
    if not parts:
        raise _unreadable(where, "it holds no triangle")
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    points_obj = np.concatenate([part.vertices for part in parts])
    linear, offset = T_objmesh_from_canonical[:3, :3], T_objmesh_from_canonical[:3, 3]
    return TexturedMesh(
        vertices=((points_obj - offset) @ np.linalg.inv(linear).T).astype(np.float32),
        normals=np.concatenate([part.normals for part in parts]),
        uv=np.concatenate([part.uv for part in parts]),
        colors=np.concatenate([part.colors for part in parts]),
        faces=np.concatenate([part.faces + start for part, start in zip(parts, starts)]).astype(np.int32),
        face_texture=np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts]).astype(np.int32),
        textures=tuple(part.textures[0] for part in parts),
        wraps=tuple(part.wraps[0] for part in parts),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshRecord:
    """Where the mesh of an object is, without its bytes."""

    object_uid: str
    mesh_sha256: str
    T_objmesh_from_canonical: Float[np.ndarray, "4 4"]
    shard: Shard

    def read(self) -> TexturedMesh:
        """ModelError where the shard may not hold the mesh, or where it is broken; ShardError."""
        table = self.shard.read_object(self.object_uid, ["mesh_glb"])
        (glb,) = table["mesh_glb"]
        if glb is None:
            raise ModelError(
                table.where,
                "has no mesh: its licence forbids copies",
                expected="mesh_glb, of which features of views are made",
                action="Leave its shard out, give the cache folder where its features are, or use features: {}.",
            )
        return textured_mesh(glb, self.T_objmesh_from_canonical, where=table.where)


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectMeshes:
    """Finds objects in shards by name; looks no further than it has to. Not shared between threads."""

    shards: Sequence[Shard]
    _found: dict[str, MeshRecord] = field(default_factory=dict, init=False)

    def record(self, object_uid: str) -> MeshRecord:
        """Of the first shard that has the object. DatasetNotFoundError, ShardError."""
        if object_uid not in self._found:
            self._found[object_uid] = self._search(object_uid)
        return self._found[object_uid]

    def _search(self, object_uid: str) -> MeshRecord:
        shard = next((shard for shard in self.shards if shard.has_object(object_uid)), None)
        if shard is None:
            raise DatasetNotFoundError(
                "no such object", where=", ".join(shard.path for shard in self.shards), found=object_uid
            )
        table = shard.read_object(object_uid, ["mesh_sha256", "T_objmesh_from_canonical"])
        return MeshRecord(
            object_uid=object_uid,
            mesh_sha256=table["mesh_sha256"][0],
            T_objmesh_from_canonical=table["T_objmesh_from_canonical"][0],
            shard=shard,
        )


def _with_numbered_materials(glb: bytes) -> tuple[bytes, dict[str, Any]]:
    """The file with its materials named by their numbers, and its JSON: trimesh tells the name, not the sampler."""
    (length,) = struct.unpack_from("<I", glb, 12)
    document = json.loads(glb[20 : 20 + length])
    for index, material in enumerate(document.get("materials", [])):
        material["name"] = str(index)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = glb[20 + length :]
    header = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
    return header + text + rest, document


def _part(scene: trimesh.Scene, node: str, document: dict[str, Any]) -> TexturedMesh:
    """One geometry of the file in the object's frame, metres."""
    T, name = scene.graph[node]
    part = scene.geometry[name].copy()
    part.apply_transform(T)
    count, visual = len(part.vertices), scene.geometry[name].visual  # copies lose COLOR_0 beside a material
    material = getattr(visual, "material", None)
    vertex_colors = visual.vertex_colors if material is None else visual.vertex_attributes.get("color")
    look = _Look()
    if material is not None:
        entry = document["materials"][int(material.name)] if material.name is not None else {}
        look = _look(
            material, entry, document, has_uv=visual.uv is not None, tinted=vertex_colors is not None
        )
    colors = np.tile(look.factor, (count, 1))
    if vertex_colors is not None:
        colors = colors * _unit_range(np.asarray(vertex_colors)[:, :3])
    return TexturedMesh(
        vertices=(part.vertices @ ROTATION_YUP_FROM_OBJ).astype(np.float32),
        normals=(part.vertex_normals @ ROTATION_YUP_FROM_OBJ).astype(np.float32),
        uv=(np.zeros((count, 2)) if look.texture is _WHITE else visual.uv).astype(np.float32),
        colors=colors.astype(np.float32),
        faces=part.faces.astype(np.int32),
        face_texture=np.zeros(len(part.faces), np.int32),
        textures=(look.texture,),
        wraps=(look.wraps,),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Look:
    """What multiplies the vertex colours of one part."""

    factor: Float[np.ndarray, " rgb"] = field(default_factory=lambda: np.ones(3))  # linear
    texture: UInt8[np.ndarray, "_ _ 3"] = field(default_factory=lambda: _WHITE)  # sRGB
    wraps: tuple[Wrap, Wrap] = ("repeat", "repeat")
    tex_coord: int = 0


def _look(
    material: trimesh.visual.material.PBRMaterial,
    entry: dict[str, Any],
    document: dict[str, Any],
    *,
    has_uv: bool,
    tinted: bool,
) -> _Look:
    """The brighter of base colour and emission."""
    stated = material.baseColorFactor
    factor = np.ones(3) if stated is None else np.asarray(stated)[:3] / 255.0
    info = entry.get("pbrMetallicRoughness", {}).get("baseColorTexture")
    base = _texture_look(factor, material.baseColorTexture if has_uv else None, info, document)
    glow_factor = np.zeros(3) if material.emissiveFactor is None else np.asarray(material.emissiveFactor)
    if tinted or not glow_factor.any():
        return base
    image = material.emissiveTexture if has_uv else None
    glow = _texture_look(np.minimum(glow_factor, 1.0), image, entry.get("emissiveTexture"), document)
    both = base.texture is not _WHITE and glow.texture is not _WHITE
    if glow.tex_coord or (both and base.wraps != glow.wraps):
        return base
    return _brighter(base, glow) if base.factor.any() else glow


def _texture_look(
    factor: Float[np.ndarray, " rgb"],
    image: Image.Image | None,
    info: dict[str, Any] | None,
    document: dict[str, Any],
) -> _Look:
    if image is None or info is None:
        return _Look(factor=factor)
    texture = document["textures"][info["index"]]
    sampler = document["samplers"][texture["sampler"]] if "sampler" in texture else {}
    return _Look(
        factor=factor,
        texture=np.asarray(image.convert("RGB")),
        wraps=(WRAPS[sampler.get("wrapS", 10497)], WRAPS[sampler.get("wrapT", 10497)]),
        tex_coord=info.get("texCoord", 0),
    )


def _brighter(base: _Look, glow: _Look) -> _Look:
    """Both factors and textures in one texture, of the larger size."""
    larger = max(base, glow, key=lambda look: look.texture.size)
    height, width = larger.texture.shape[:2]
    linear = [
        look.factor
        * linear_from_srgb(np.asarray(Image.fromarray(look.texture).resize((width, height))) / 255.0)
        for look in (base, glow)
    ]
    texture = np.round(255.0 * srgb_from_linear(np.maximum(*linear))).astype(np.uint8)
    return _Look(texture=texture, wraps=larger.wraps)


def _unit_range(colors: np.ndarray) -> np.ndarray:
    return colors / np.iinfo(colors.dtype).max if np.issubdtype(colors.dtype, np.integer) else colors


def _unreadable(where: str, problem: str) -> ModelError:
    return ModelError(
        where,
        f"its mesh cannot be read ({problem})",
        expected="a binary glTF",
        action="Make the shard again.",
    )
