"""The table top's material: its drawn textures on Blender's Principled BSDF."""

import bpy
import numpy as np
from jaxtyping import Float, Float32

from datagen.blender.nodes import Input, new_material, surface
from datagen.blender.table_textures import TableTextures, draw_table
from datagen.scene import Table

__all__ = ["table_material", "table_uv"]


def table_material(table: Table) -> bpy.types.Material:
    """Colour with roughness in its alpha, and a normal map: two look-ups per shading point."""
    textures = draw_table(table)
    material, graph = new_material(f"table {table.material}")
    color_roughness = np.concatenate([_srgb(textures.color), textures.roughness[..., None]], axis=-1)
    drawn = graph.image(_image("table colour", color_roughness, is_color=True), extension="MIRROR")
    inputs: dict[str | int, Input] = {
        "Base Color": drawn.outputs["Color"],
        "Roughness": drawn.outputs["Alpha"],
    }
    if textures.height_m.any():
        relief = graph.image(_image("table relief", _normals(textures), is_color=False), extension="MIRROR")
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


def _image(name: str, rgba: Float32[np.ndarray, "row column 4"], *, is_color: bool) -> bpy.types.Image:
    height, width = rgba.shape[:2]
    image = bpy.data.images.new(name, width, height, alpha=True, is_data=not is_color)
    image.alpha_mode = "CHANNEL_PACKED"
    image.pixels.foreach_set(np.ascontiguousarray(rgba, np.float32).reshape(-1))
    image.update()
    return image


def _normals(textures: TableTextures) -> Float32[np.ndarray, "row column 4"]:
    """Tangent-space normals of the relief, coded 0..1."""
    slope_y, slope_x = np.gradient(textures.height_m, textures.texel_m)
    normal = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.concatenate([0.5 * normal + 0.5, np.ones_like(slope_x)[..., None]], axis=-1).astype(np.float32)


def _srgb(linear: Float32[np.ndarray, "row column 3"]) -> Float32[np.ndarray, "row column 3"]:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055).astype(np.float32)
