"""Materials of the held object: glTF metallic-roughness on Blender's Principled BSDF."""

import bpy

from datagen.blender.shading.images import add_image
from datagen.blender.shading.nodes import Graph, Input, new_material, replace_surface, surface
from datagen.objects.mesh.object_mesh import Material

__all__ = ["object_material"]

# Handled things are never equally glossy all over: smudges change roughness by about this much.
_SMUDGE = 0.12
_UNBENT = 0.85  # of the light; the rest stays as the faint shadow that glass has


def object_material(material: Material) -> bpy.types.Material:
    """One object material. Alpha is not drawn: masks and images must show the same outline.

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
    shader = surface(graph, inputs)
    if material.transmission > 0.0:
        _let_light_through(graph, shader, material)
    return drawn


def _let_light_through(graph: Graph, shader: bpy.types.NodeSocket, material: Material) -> None:
    """Shadow and diffuse rays pass glass unbent.

    Without caustics, which would take thousands of samples, glass would cast the shadow of a
    stone and what stands inside it would be black.
    """
    path = graph.node("ShaderNodeLightPath", {}).outputs
    unbent = graph.math("MAXIMUM", path["Is Shadow Ray"], path["Is Diffuse Ray"])
    tint = graph.node("ShaderNodeBsdfTransparent", {"Color": material.base_color_rgba[:3]}).outputs[0]
    share = graph.math("MULTIPLY", unbent, _UNBENT * material.transmission)
    replace_surface(graph, graph.node("ShaderNodeMixShader", {0: share, 1: shader, 2: tint}).outputs[0])


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
