"""Materials of the held object: glTF metallic-roughness on Blender's Principled BSDF."""

import bpy

from datagen.blender.images import add_image
from datagen.blender.nodes import Graph, Input, new_material, surface
from datagen.objects.mesh import Material

__all__ = ["object_material"]

# Handled things are never equally glossy all over: smudges change roughness by about this much.
_SMUDGE = 0.12


def object_material(material: Material) -> bpy.types.Material:
    """One object material. Alpha is not drawn: masks and pictures must show the same outline.

    Raises TextureError when an image is damaged.
    """
    drawn, graph = new_material(material.name)
    metallic, roughness = _metallic_roughness(graph, material)
    inputs: dict[str | int, Input] = {
        "Base Color": _base_color(graph, material),
        "Metallic": metallic,
        "Roughness": _smudged(graph, roughness),
        "IOR": material.ior,
        "Transmission Weight": material.transmission,
    }
    if material.normal_image is not None:
        texture = graph.image(add_image(material.normal_image, f"{material.name} normals", is_color=False))
        inputs["Normal"] = graph.node("ShaderNodeNormalMap", {"Color": texture.outputs["Color"]}).outputs[0]
    if any(material.emissive_rgb):
        inputs["Emission Color"] = _emission(graph, material)
        inputs["Emission Strength"] = 1.0
    surface(graph, inputs)
    return drawn


def _base_color(graph: Graph, material: Material) -> Input:
    factor = material.base_color_rgba[:3]
    if material.base_color_image is None:
        return factor
    texture = graph.image(add_image(material.base_color_image, f"{material.name} colour", is_color=True))
    return graph.mix(1.0, texture.outputs["Color"], factor, blend="MULTIPLY")


def _metallic_roughness(graph: Graph, material: Material) -> tuple[Input, Input]:
    if material.metallic_roughness_image is None:
        return material.metallic, material.roughness
    image = add_image(material.metallic_roughness_image, f"{material.name} roughness", is_color=False)
    channels = graph.node("ShaderNodeSeparateColor", {0: graph.image(image).outputs["Color"]}).outputs
    metallic = graph.math("MULTIPLY", channels["Blue"], material.metallic)
    return metallic, graph.math("MULTIPLY", channels["Green"], material.roughness)


def _smudged(graph: Graph, roughness: Input) -> Input:
    where = graph.node("ShaderNodeTexCoord", {}).outputs["Object"]
    smudge = graph.remap(graph.noise(where, 45.0, detail=1.0), 0.35, 0.7, -0.3 * _SMUDGE, _SMUDGE)
    return graph.math("ADD", roughness, smudge, clamp=True)


def _emission(graph: Graph, material: Material) -> Input:
    if material.emissive_image is None:
        return material.emissive_rgb
    texture = graph.image(add_image(material.emissive_image, f"{material.name} emission", is_color=True))
    return graph.mix(1.0, texture.outputs["Color"], material.emissive_rgb, blend="MULTIPLY")
