"""Area lamps."""

import bpy
from mathutils import Vector

from datagen.scene.scene import AreaLight

__all__ = ["add_light"]


def add_light(light: AreaLight, name: str) -> None:
    """A square lamp that shines from its position towards its target; not seen by the camera."""
    lamp = bpy.data.lights.new(name, "AREA")
    lamp.shape = "SQUARE"
    lamp.size = light.size_m
    lamp.energy = light.power_w
    lamp.color = light.color_rgb
    placed = bpy.data.objects.new(name, lamp)
    placed.location = Vector(light.position_world)
    placed.rotation_euler = (Vector(light.target_world) - placed.location).to_track_quat("-Z", "Y").to_euler()
    placed.visible_camera = False
    bpy.context.scene.collection.objects.link(placed)
