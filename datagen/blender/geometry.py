"""Blender meshes from arrays, and their motion."""

from typing import Any

import bpy
import numpy as np
from jaxtyping import Float, Int
from mathutils import Matrix

from datagen.objects.mesh.object_mesh import ObjectMesh

__all__ = [
    "CORNER_COLORS",
    "add_mesh",
    "add_object_mesh",
    "add_vertex_attribute",
    "set_pose",
    "set_vertices",
    "uv_layer_name",
]

CORNER_COLORS = "corner colours"
_AUTO_SMOOTH_RAD = np.radians(40.0)


def add_mesh(
    name: str,
    *,
    verts: Float[np.ndarray, "vert 3"],
    faces: Int[np.ndarray, "face 3"],
    corner_uv: Float[np.ndarray, "face 3 2"],
    face_material: Int[np.ndarray, " face"],
    materials: list[bpy.types.Material],
) -> bpy.types.Object:
    """A smooth-shaded triangle mesh in the current scene; `face_material` indexes `materials`."""
    mesh = bpy.data.meshes.new(name)
    n_corners = 3 * len(faces)
    mesh.vertices.add(len(verts))
    mesh.loops.add(n_corners)
    mesh.polygons.add(len(faces))
    _fill(mesh.vertices, "co", verts, np.float32)
    _fill(mesh.loops, "vertex_index", faces, np.int32)
    _fill(mesh.polygons, "loop_start", np.arange(0, n_corners, 3), np.int32)
    _fill(mesh.polygons, "material_index", face_material, np.int32)
    _fill(mesh.uv_layers.new(name=uv_layer_name(0)).uv, "vector", corner_uv, np.float32)
    for material in materials:
        mesh.materials.append(material)
    mesh.update(calc_edges=True)
    mesh.shade_smooth()
    drawn = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(drawn)
    return drawn


def add_object_mesh(mesh: ObjectMesh, materials: list[bpy.types.Material]) -> bpy.types.Object:
    """The held object at the origin of its own frame.

    Vertices at the same place are joined first: a file that splits them along UV seams would
    show the seams as creases. Positions do not change, so annotation sees the same surface.
    """
    verts, joined = np.unique(mesh.verts_obj, axis=0, return_inverse=True)
    faces = joined.reshape(-1)[mesh.faces]
    watertight = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    drawn = add_mesh(
        "object",
        verts=verts,
        faces=faces[watertight],
        corner_uv=mesh.corner_uv[watertight],
        face_material=mesh.face_material[watertight],
        materials=materials,
    )
    for layer, uv in enumerate(mesh.more_corner_uv, start=1):
        more = drawn.data.uv_layers.new(name=uv_layer_name(layer), do_init=False)
        _fill(more.uv, "vector", uv[watertight], np.float32)
    if mesh.corner_colors is not None:
        rgba = np.ones((3 * len(faces[watertight]), 4))
        rgba[:, :3] = mesh.corner_colors[watertight].reshape(-1, 3)
        added = drawn.data.attributes.new(CORNER_COLORS, "FLOAT_COLOR", "CORNER")
        _fill(added.data, "color", rgba, np.float32)
    if mesh.smooth:
        drawn.data.set_sharp_from_angle(angle=_AUTO_SMOOTH_RAD)
    else:
        drawn.data.shade_flat()
    return drawn


def uv_layer_name(layer: int) -> str:
    """Of `ImageLayout.uv_layer`; the first is what image textures use unasked."""
    return f"UVMap.{layer:03d}" if layer else "UVMap"


def set_vertices(drawn: bpy.types.Object, verts: Float[np.ndarray, "vert 3"]) -> None:
    """Move the vertices of a mesh made by `add_mesh`; topology, UVs and attributes stay."""
    _fill(drawn.data.vertices, "co", verts, np.float32)
    drawn.data.update()


def set_pose(drawn: bpy.types.Object, T_world_from_obj: Float[np.ndarray, "4 4"]) -> None:
    """Place an object (or a camera with Blender's axes) in the world."""
    drawn.matrix_world = Matrix(T_world_from_obj.tolist())


def add_vertex_attribute(
    drawn: bpy.types.Object, name: str, values: Float[np.ndarray, "vert 3"] | Float[np.ndarray, " vert"]
) -> None:
    """A named attribute that shaders read: a vector per vertex, or one number per vertex."""
    kind, field = ("FLOAT_VECTOR", "vector") if values.ndim == 2 else ("FLOAT", "value")
    _fill(drawn.data.attributes.new(name, kind, "POINT").data, field, values, np.float32)


def _fill(collection: Any, field: str, values: np.ndarray, dtype: type) -> None:
    collection.foreach_set(field, np.ascontiguousarray(values, dtype).reshape(-1))
