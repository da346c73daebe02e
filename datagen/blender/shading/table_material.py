"""The table top's material: its drawn textures on Blender's Principled BSDF."""

import bpy
import numpy as np
from jaxtyping import Float

from datagen.blender.shading.images import add_drawn_image, coded_normals
from datagen.blender.shading.nodes import Input, new_material, surface
from datagen.blender.shading.table_textures import draw_table
from datagen.scene.scene import Table
from shards.color import srgb_from_linear

__all__ = ["table_material", "table_uv"]


def table_material(table: Table) -> bpy.types.Material:
    """Colour with roughness in its alpha, and a normal map: two look-ups per shading point."""
    textures = draw_table(table)
    material, graph = new_material(f"table {table.material}")
    color_roughness = np.concatenate(
        [srgb_from_linear(textures.color), textures.roughness[..., None]], axis=-1
    )
    drawn = graph.image(add_drawn_image("table colour", color_roughness, is_color=True), extension="MIRROR")
    inputs: dict[str | int, Input] = {
        "Base Color": drawn.outputs["Color"],
        "Roughness": drawn.outputs["Alpha"],
    }
    if textures.height_m.any():
        coded = coded_normals(textures.height_m, textures.texel_m)
        relief = graph.image(add_drawn_image("table relief", coded, is_color=False), extension="MIRROR")
        inputs["Normal"] = graph.node(
            "ShaderNodeNormalMap", {"Color": relief.outputs["Color"]}, uv_map="UVMap"
        ).outputs[0]
    if table.material == "cloth":
        inputs |= {"Specular IOR Level": 0.2, "Sheen Weight": 0.15}
    surface(graph, inputs)
    return material


def table_uv(
    table: Table, verts_table: Float[np.ndarray, "vert 3"], faces: np.ndarray
) -> Float[np.ndarray, "face 3 2"]:
    """Plan coordinates, 0..1 over the top; the pattern wraps around the edge without stretching."""
    half = 0.5 * np.asarray(table.size_xy_m)
    xy = verts_table[:, :2]
    outward = xy - np.clip(xy, 0.05 - half, half - 0.05)
    length = np.linalg.norm(outward, axis=1, keepdims=True)
    outward = np.divide(outward, length, out=np.zeros_like(outward), where=length > 0.0)
    around = xy - outward * verts_table[:, 2:3]  # the top is z = 0, the side below it
    return ((around + half) / (2.0 * half))[faces]
