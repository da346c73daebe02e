"""Shader graphs written as expressions: sockets go in, sockets come out."""

from typing import Any, TypeAlias

import bpy

__all__ = ["Graph", "Input", "new_material", "replace_surface", "surface"]

# A number, a colour or vector, or the output of another node.
Input: TypeAlias = float | tuple[float, ...] | bpy.types.NodeSocket

_OUTPUT = "surface output"


class Graph:
    """Adds nodes to one node tree. Inputs are named as in Blender's user interface."""

    def __init__(self, tree: bpy.types.NodeTree) -> None:
        self.tree = tree

    def node(self, kind: str, inputs: dict[str | int, Input], **settings: Any) -> bpy.types.Node:
        """A node of Blender type `kind` with its settings made and its inputs set or linked."""
        node = self.tree.nodes.new(kind)
        for name, value in settings.items():
            setattr(node, name, value)
        for key, value in inputs.items():
            self._connect(node.inputs[key], value)
        return node

    def math(self, operation: str, *operands: Input, clamp: bool = False) -> bpy.types.NodeSocket:
        """A Math node, e.g. math("MULTIPLY", a, 2.0)."""
        return self.node(
            "ShaderNodeMath", dict(enumerate(operands)), operation=operation, use_clamp=clamp
        ).outputs[0]

    def noise(
        self, where: Input, scale: float, detail: float = 2.0, roughness: float = 0.5
    ) -> bpy.types.NodeSocket:
        """Gradient noise in 0..1, mean 0.5; `scale` is features per metre when `where` is in metres."""
        inputs: dict[str | int, Input] = {
            "Vector": where,
            "Scale": scale,
            "Detail": detail,
            "Roughness": roughness,
        }
        return self.node("ShaderNodeTexNoise", inputs).outputs["Fac"]

    def remap(
        self, value: Input, low: float, high: float, to_low: float, to_high: float
    ) -> bpy.types.NodeSocket:
        """Smooth step of `value` from [low, high] to [to_low, to_high], clamped."""
        inputs: dict[str | int, Input] = {0: value, 1: low, 2: high, 3: to_low, 4: to_high}
        return self.node("ShaderNodeMapRange", inputs, interpolation_type="SMOOTHSTEP").outputs[0]

    def mix(self, factor: Input, a: Input, b: Input, blend: str = "MIX") -> bpy.types.NodeSocket:
        """Colour a where factor is 0, blended with b where it is 1."""
        node = self.tree.nodes.new("ShaderNodeMix")
        node.data_type, node.blend_type = "RGBA", blend
        for socket, value in zip((node.inputs[0], node.inputs[6], node.inputs[7]), (factor, a, b)):
            self._connect(socket, value)
        return node.outputs[2]

    def combine(self, x: Input, y: Input, z: Input) -> bpy.types.NodeSocket:
        """Vector from three numbers."""
        return self.node("ShaderNodeCombineXYZ", {0: x, 1: y, 2: z}).outputs[0]

    def attribute(self, name: str, output: str) -> bpy.types.NodeSocket:
        """A mesh attribute; `output` is "Vector", "Color" or "Fac"."""
        return self.node("ShaderNodeAttribute", {}, attribute_name=name).outputs[output]

    def image(self, image: bpy.types.Image, where: Input | None = None, **settings: Any) -> bpy.types.Node:
        """An image texture at the UV coordinates of the mesh, or at those of `where`."""
        inputs: dict[str | int, Input] = {} if where is None else {"Vector": where}
        return self.node("ShaderNodeTexImage", inputs, image=image, **settings)

    def bump(self, height_m: Input, strength: float, normal: Input | None = None) -> bpy.types.NodeSocket:
        """Normal of a surface raised by `height_m` metres."""
        inputs: dict[str | int, Input] = {"Height": height_m, "Strength": strength, "Distance": 1.0}
        if normal is not None:
            inputs["Normal"] = normal
        return self.node("ShaderNodeBump", inputs).outputs[0]

    def _connect(self, socket: bpy.types.NodeSocket, value: Input) -> None:
        if isinstance(value, bpy.types.NodeSocket):
            self.tree.links.new(value, socket)
        elif isinstance(value, tuple) and len(value) == 3 and socket.type == "RGBA":
            socket.default_value = (*value, 1.0)
        else:
            socket.default_value = value


def new_material(name: str) -> tuple[bpy.types.Material, Graph]:
    """An empty material and the graph to fill; end it with `surface`."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    material.node_tree.nodes.clear()
    return material, Graph(material.node_tree)


def surface(graph: Graph, inputs: dict[str | int, Input], **settings: Any) -> bpy.types.NodeSocket:
    """Principled BSDF with `inputs`, connected to the material's output."""
    shader = graph.node("ShaderNodeBsdfPrincipled", inputs, **settings).outputs[0]
    graph.node("ShaderNodeOutputMaterial", {"Surface": shader}, name=_OUTPUT)
    return shader


def replace_surface(graph: Graph, shader: bpy.types.NodeSocket) -> None:
    """Connect another shader to the output that `surface` made."""
    graph.tree.links.new(shader, graph.tree.nodes[_OUTPUT].inputs["Surface"])
