"""A whole Scene in Blender, and its state at one frame seen by one camera."""

from dataclasses import dataclass

import bpy
import numpy as np

from datagen.blender.axes import SENSOR_WIDTH_MM, blender_lens, world_from_blender_camera
from datagen.blender.geometry import add_mesh, add_object_mesh, add_vertex_attribute, set_pose, set_vertices
from datagen.blender.lights import add_light
from datagen.blender.shading.object_materials import object_material
from datagen.blender.shading.skin import (
    ARM_BLEND,
    ARM_COLOR,
    REST,
    arm_color_and_blend,
    skin_materials,
    sleeve_material,
)
from datagen.blender.shading.table_material import table_material, table_uv
from datagen.blender.world import add_world
from datagen.scene.scene import SLEEVE, CameraPath, Scene, Table
from datagen.scene.table_mesh import table_mesh
from shards.geometry import invert_transform, transform_points

__all__ = ["BuiltScene", "PassIndex", "build_scene", "show_frame", "use_camera"]


class PassIndex:
    """Values of Cycles' material-index pass; 0 is the background.

    By material, because hand and forearm are one mesh: light scatters through the wrist.
    """

    OBJECT, HAND, ARM, TABLE = 1, 2, 3, 4


@dataclass(frozen=True, kw_only=True)
class BuiltScene:
    """What moves from frame to frame."""

    scene: Scene
    held: bpy.types.Object
    hand: bpy.types.Object
    camera: bpy.types.Object


def build_scene(scene: Scene) -> BuiltScene:
    """Empty Blender and fill it with `scene`. Raises TextureError when an image cannot be used."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    drawn = scene.object_mesh
    held = add_object_mesh(
        drawn, [object_material(m, tinted=drawn.corner_colors is not None) for m in drawn.materials]
    )
    _mark(held, [PassIndex.OBJECT] * len(drawn.materials))
    hand = _add_hand(scene)
    if scene.table is not None:
        _add_table(scene.table)
    add_world(scene.background)
    for index, light in enumerate(scene.lights):
        add_light(light, f"light-{index}")
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    return BuiltScene(scene=scene, held=held, hand=hand, camera=camera)


def show_frame(built: BuiltScene, frame: int) -> None:
    """Move hand and object to their places at `frame`."""
    set_vertices(built.hand, built.scene.hand_verts_world[frame])
    set_pose(built.held, built.scene.T_world_from_obj[frame])


def use_camera(built: BuiltScene, camera: CameraPath, frame: int) -> None:
    """See the scene through `camera` as it stands at `frame`; sets the image's size too."""
    lens = blender_lens(camera.K, camera.image_size)
    data, render = built.camera.data, bpy.context.scene.render
    data.sensor_fit, data.sensor_width, data.lens = "HORIZONTAL", SENSOR_WIDTH_MM, lens.focal_mm
    data.shift_x, data.shift_y = lens.shift_x, lens.shift_y
    data.clip_start, data.clip_end = 0.01, 1000.0
    render.resolution_x, render.resolution_y = camera.image_size
    render.resolution_percentage = 100
    render.pixel_aspect_x, render.pixel_aspect_y = lens.pixel_aspect_x, lens.pixel_aspect_y
    set_pose(built.camera, world_from_blender_camera(camera.T_cam_from_world[frame]))


def _add_hand(scene: Scene) -> bpy.types.Object:
    surface, look = scene.hand_surface, scene.hand_look
    rest = scene.hand_verts_world[0]
    sleeve = rest[np.unique(surface.faces[surface.face_part == SLEEVE])]
    axis = np.linalg.svd(sleeve - sleeve.mean(axis=0))[2][0] if len(sleeve) else np.array([1.0, 0.0, 0.0])
    hand_skin, arm_skin = skin_materials(look, surface, rest, scene.seed)
    hand = add_mesh(
        "hand",
        verts=rest,
        faces=surface.faces,
        corner_uv=surface.corner_uv,
        face_material=surface.face_part,
        materials=[hand_skin, arm_skin, sleeve_material(look, axis)],  # in the order of face_part
    )
    _mark(hand, [PassIndex.HAND, PassIndex.ARM, PassIndex.ARM])
    color, blend = arm_color_and_blend(surface, rest, look)
    for name, values in ((REST, rest), (ARM_COLOR, color), (ARM_BLEND, blend)):
        add_vertex_attribute(hand, name, values)
    return hand


def _add_table(table: Table) -> None:
    mesh = table_mesh(table)
    T_world_from_table = np.eye(4)
    c, s = np.cos(table.yaw_rad), np.sin(table.yaw_rad)
    T_world_from_table[:2, :2] = [[c, -s], [s, c]]
    T_world_from_table[:3, 3] = [*table.center_xy_m, table.top_z_m]
    verts_table = transform_points(invert_transform(T_world_from_table), mesh.verts_world)
    top = add_mesh(
        "table",
        verts=verts_table,
        faces=mesh.faces,
        corner_uv=table_uv(table, verts_table, mesh.faces),
        face_material=np.zeros(len(mesh.faces), int),
        materials=[table_material(table)],
    )
    _mark(top, [PassIndex.TABLE])
    top.data.set_sharp_from_angle(angle=np.radians(40.0))
    set_pose(top, T_world_from_table)


def _mark(drawn: bpy.types.Object, pass_indices: list[int]) -> None:
    for material, index in zip(drawn.data.materials, pass_indices):
        material.pass_index = index
