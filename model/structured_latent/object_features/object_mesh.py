"""The textured meshes of the shards' objects, in the canonical frame.

Read of a GLB, as `datagen` writes them: base colours (factors, images, vertex colours), UVs and normals. Base colour
factors keep 8 bits (trimesh); everything is opaque, and nothing shines or glows by itself.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import trimesh
from jaxtyping import Float, Float32, Int32, UInt8

from model.errors import ModelError
from model.surface.export import ROTATION_YUP_FROM_OBJ
from shards.errors import DatasetNotFoundError
from shards.reader import Shard

__all__ = ["MeshRecord", "ObjectMeshes", "TexturedMesh", "textured_mesh"]

_WHITE = np.full((1, 1, 3), 255, dtype=np.uint8)


@dataclass(frozen=True, kw_only=True, eq=False)
class TexturedMesh:
    """Triangles that may be open, may intersect and are seen from both sides; canonical frame."""

    vertices: Float32[np.ndarray, "vertex 3"]
    normals: Float32[np.ndarray, "vertex 3"]  # unit, for shading
    uv: Float32[np.ndarray, "vertex 2"]  # (0, 0) is the lower left of the image, which repeats
    colors: Float32[np.ndarray, "vertex 3"]  # linear light, 0..1; times the texture
    faces: Int32[np.ndarray, "face 3"]
    face_texture: Int32[np.ndarray, " face"]  # index into `textures`
    textures: tuple[UInt8[np.ndarray, "_ _ 3"], ...]  # sRGB; white where a material has none


def textured_mesh(
    glb: bytes, T_objmesh_from_canonical: Float[np.ndarray, "4 4"], *, where: str
) -> TexturedMesh:
    """The mesh of a shard (binary glTF, Y up, metres). ModelError, naming `where`, when it cannot be read."""
    try:
        scene = trimesh.load_scene(io.BytesIO(glb), file_type="glb", process=False)
        parts = [_part(scene, node) for node in scene.graph.nodes_geometry]
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


def _part(scene: trimesh.Scene, node: str) -> TexturedMesh:
    """One geometry of the file in the object's frame, metres."""
    T, name = scene.graph[node]
    part = scene.geometry[name].copy()
    part.apply_transform(T)
    count, visual = len(part.vertices), part.visual
    colors, uv, texture = np.ones((count, 3)), np.zeros((count, 2)), _WHITE
    material = getattr(visual, "material", None)
    if material is not None:
        if material.baseColorFactor is not None:
            colors = colors * np.asarray(material.baseColorFactor)[:3] / 255.0
        if material.baseColorTexture is not None and visual.uv is not None:
            uv, texture = visual.uv, np.asarray(material.baseColorTexture.convert("RGB"))
    vertex_colors = part.vertex_attributes.get("color") if material is not None else visual.vertex_colors
    if vertex_colors is not None:
        colors = colors * _unit_range(np.asarray(vertex_colors)[:, :3])
    return TexturedMesh(
        vertices=(part.vertices @ ROTATION_YUP_FROM_OBJ).astype(np.float32),
        normals=(part.vertex_normals @ ROTATION_YUP_FROM_OBJ).astype(np.float32),
        uv=uv.astype(np.float32),
        colors=colors.astype(np.float32),
        faces=part.faces.astype(np.int32),
        face_texture=np.zeros(len(part.faces), np.int32),
        textures=(texture,),
    )


def _unit_range(colors: np.ndarray) -> np.ndarray:
    return colors / np.iinfo(colors.dtype).max if np.issubdtype(colors.dtype, np.integer) else colors


def _unreadable(where: str, problem: str) -> ModelError:
    return ModelError(
        where,
        f"its mesh cannot be read ({problem})",
        expected="a binary glTF",
        action="Make the shard again.",
    )
