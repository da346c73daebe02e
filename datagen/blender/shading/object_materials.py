"""Materials of the held object: glTF metallic-roughness on Blender's Principled BSDF."""

import bpy

from datagen.blender.geometry import CORNER_COLORS, uv_layer_name
from datagen.blender.shading.images import add_image
from datagen.blender.shading.nodes import Graph, Input, new_material, replace_surface, surface
from datagen.objects.mesh.object_mesh import ImageLayout, Material
from shards.texture_wrap import Wrap

__all__ = ["object_material"]

# Handled things are never equally glossy all over: smudges change roughness by about this much.
_SMUDGE = 0.12
_EXTENSIONS: dict[Wrap, str] = {"repeat": "REPEAT", "mirror": "MIRROR", "clamp": "EXTEND"}
_UNBENT = 0.85  # of the light; the rest stays as the faint shadow that glass has


def object_material(material: Material, *, tinted: bool) -> bpy.types.Material:
    """One object material; `tinted`: the mesh has colours at its corners, which multiply the base colour.

    Alpha is not drawn: masks and images must show the same outline. What glows adds its light, also
    where a black base shows that a file means its emission as the colour: such an image holds light
    already, and would be lit twice as a base colour.

    Raises TextureError when an image is damaged.
    """
    drawn, graph = new_material(material.name)
    metallic, roughness = _metallic_roughness(graph, material)
    inputs: dict[str | int, Input] = {
        "Base Color": _base_color(graph, material, tinted),
        "Metallic": metallic,
        "Roughness": _smudged(graph, roughness),
        "IOR": material.ior,
        "Transmission Weight": material.transmission,
    }
    if material.normal_image is not None:
        layout, what = material.normal_layout, f"{material.name} normals"
        normal = _image_color(graph, material.normal_image, layout, what, is_color=False)
        tangents = {"uv_map": uv_layer_name(layout.uv_layer)} if layout.uv_layer else {}
        inputs["Normal"] = graph.node("ShaderNodeNormalMap", {"Color": normal}, **tangents).outputs[0]
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


def _base_color(graph: Graph, material: Material, tinted: bool) -> Input:
    color: Input = material.base_color_rgba[:3]
    if material.base_color_image is not None:
        layout, what = material.base_color_layout, f"{material.name} colour"
        image = _image_color(graph, material.base_color_image, layout, what, is_color=True)
        color = graph.mix(1.0, image, color, blend="MULTIPLY")
    if tinted:
        color = graph.mix(1.0, graph.attribute(CORNER_COLORS, "Color"), color, blend="MULTIPLY")
    return color


def _image_color(
    graph: Graph, data: bytes, layout: ImageLayout, what: str, *, is_color: bool
) -> bpy.types.NodeSocket:
    """Colour of an image as `layout` lays it on the surface."""
    image = add_image(data, what, is_color=is_color)
    alike = layout.wrap_u == layout.wrap_v
    if alike and not layout.uv_layer:
        return graph.image(image, extension=_EXTENSIONS[layout.wrap_u]).outputs["Color"]
    where = graph.node("ShaderNodeUVMap", {}, uv_map=uv_layer_name(layout.uv_layer)).outputs[0]
    if alike:
        return graph.image(image, where, extension=_EXTENSIONS[layout.wrap_u]).outputs["Color"]
    # Blender wraps both axes alike: all repeats, and axes that should not are kept off the borders.
    u, v, _ = graph.node("ShaderNodeSeparateXYZ", {0: where}).outputs
    width, height = image.size
    inside = graph.combine(
        _inside(graph, u, layout.wrap_u, width), _inside(graph, v, layout.wrap_v, height), 0.0
    )
    return graph.image(image, inside, extension="REPEAT").outputs["Color"]


def _inside(graph: Graph, coordinate: Input, wrap: Wrap, n_texels: int) -> Input:
    """The same place between the centres of the first and last texel; unchanged where the image repeats."""
    if wrap == "repeat":
        return coordinate
    folded = graph.math("PINGPONG", coordinate, 1.0) if wrap == "mirror" else coordinate
    half_texel = 0.5 / n_texels
    return graph.math("MINIMUM", graph.math("MAXIMUM", folded, half_texel), 1.0 - half_texel)


def _metallic_roughness(graph: Graph, material: Material) -> tuple[Input, Input]:
    if material.metallic_roughness_image is None:
        return material.metallic, material.roughness
    layout, what = material.metallic_roughness_layout, f"{material.name} roughness"
    packed = _image_color(graph, material.metallic_roughness_image, layout, what, is_color=False)
    channels = graph.node("ShaderNodeSeparateColor", {0: packed}).outputs
    metallic = graph.math("MULTIPLY", channels["Blue"], material.metallic)
    return metallic, graph.math("MULTIPLY", channels["Green"], material.roughness)


def _smudged(graph: Graph, roughness: Input) -> Input:
    where = graph.node("ShaderNodeTexCoord", {}).outputs["Object"]
    smudge = graph.remap(graph.noise(where, 45.0, detail=1.0), 0.35, 0.7, -0.3 * _SMUDGE, _SMUDGE)
    return graph.math("ADD", roughness, smudge, clamp=True)


def _emission(graph: Graph, material: Material) -> Input:
    if material.emissive_image is None:
        return material.emissive_rgb
    layout, what = material.emissive_layout, f"{material.name} emission"
    image = _image_color(graph, material.emissive_image, layout, what, is_color=True)
    return graph.mix(1.0, image, material.emissive_rgb, blend="MULTIPLY")
