"""Image-based light, and what the camera sees behind the scene."""

import os
from pathlib import Path

import bpy
import numpy as np
import OpenEXR
from jaxtyping import Float32

from datagen.blender.shading.images import TextureError
from datagen.blender.shading.nodes import Graph
from datagen.scene.scene import Background

__all__ = ["add_world", "hdri_path"]

# The shipped HDRIs are 1024 pixels around: seen directly they need the softness of a background
# out of focus, and lamps in them must not keep the stair steps of their pixels.
_BACKDROP_BLUR_RAD = 0.008
_BACKDROP_MAX = 6.0  # radiance beyond this is white in the image anyway
_SHIPPED = Path("studiolights", "world")


def hdri_path(name: str) -> Path:
    """File of an HDRI: a path, or the name of one that ships with Blender. Raises TextureError."""
    if os.sep in name or name.lower().endswith((".exr", ".hdr")):
        path = Path(name)
        if not path.is_file():
            raise TextureError(f"{path}: no such HDRI")
        return path
    folder = Path(bpy.utils.system_resource("DATAFILES")) / _SHIPPED
    path = folder / f"{name}.exr"
    if not path.is_file():
        names = sorted(p.stem for p in folder.glob("*.exr"))
        raise TextureError(
            f"no HDRI called {name!r}; Blender ships {', '.join(names)}; or give the path of an .exr"
        )
    return path


def add_world(background: Background) -> None:
    """Light the scene by `background`; camera rays see a blurred, tamed copy of the same image."""
    radiance = _read_normalised(hdri_path(background.hdri))
    world = bpy.data.worlds.new("world")
    bpy.context.scene.world = world
    world.use_nodes = True
    world.node_tree.nodes.clear()
    graph = Graph(world.node_tree)
    direction = graph.node(
        "ShaderNodeMapping",
        {
            "Vector": graph.node("ShaderNodeTexCoord", {}).outputs["Generated"],
            "Rotation": (0.0, 0.0, background.rotation_rad),
        },
    ).outputs[0]
    # Mixed as shaders, not as colours: Cycles then skips the branch a ray does not see.
    light = _environment(graph, "light", radiance, direction, background.strength, "Linear")
    seen = _environment(graph, "backdrop", _backdrop(radiance), direction, background.strength, "Cubic")
    is_camera = graph.node("ShaderNodeLightPath", {}).outputs["Is Camera Ray"]
    mixed = graph.node("ShaderNodeMixShader", {0: is_camera, 1: light, 2: seen}).outputs[0]
    graph.node("ShaderNodeOutputWorld", {"Surface": mixed})
    world.cycles.sampling_method = "MANUAL"
    world.cycles.sample_map_resolution = 512


def _environment(
    graph: Graph,
    name: str,
    radiance: Float32[np.ndarray, "row column 3"],
    direction: bpy.types.NodeSocket,
    strength: float,
    filtering: str,
) -> bpy.types.NodeSocket:
    height, width = radiance.shape[:2]
    image = bpy.data.images.new(name, width, height, alpha=False, float_buffer=True, is_data=False)
    image.colorspace_settings.name = "Linear Rec.709"
    upward = radiance[::-1]  # Blender's first row is the lowest
    image.pixels.foreach_set(np.concatenate([upward, np.ones_like(upward[..., :1])], axis=-1).reshape(-1))
    image.update()
    texture = graph.node(
        "ShaderNodeTexEnvironment", {"Vector": direction}, image=image, interpolation=filtering
    )
    return graph.node(
        "ShaderNodeBackground", {"Color": texture.outputs["Color"], "Strength": strength}
    ).outputs[0]


def _read_normalised(path: Path) -> Float32[np.ndarray, "row column 3"]:
    """Radiance of an equirectangular EXR, scaled so that its mean luminance over the sphere is 1."""
    try:
        with OpenEXR.File(str(path)) as file:
            channels = file.channels()
            rgb = channels["RGB"].pixels if "RGB" in channels else channels["RGBA"].pixels[..., :3]
    except (RuntimeError, OSError, KeyError, ValueError) as error:
        raise TextureError(f"{path}: not a readable RGB OpenEXR image ({error})") from error
    rgb = np.maximum(np.nan_to_num(rgb.astype(np.float32)), 0.0)
    elevation = (np.arange(len(rgb)) + 0.5) / len(rgb) * np.pi
    luminance = rgb @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    mean = np.average(luminance.mean(axis=1), weights=np.sin(elevation))
    if not mean > 0.0:
        raise TextureError(f"{path}: the HDRI is black")
    return rgb / np.float32(mean)


def _backdrop(radiance: Float32[np.ndarray, "row column 3"]) -> Float32[np.ndarray, "row column 3"]:
    """The image as a lens out of focus would show it: Gaussian blur, wrapping around horizontally."""
    sigma = _BACKDROP_BLUR_RAD * radiance.shape[1] / (2.0 * np.pi)
    reach = int(np.ceil(3.0 * sigma))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2).astype(np.float32)
    weights /= weights.sum()
    tamed = np.minimum(radiance, np.float32(_BACKDROP_MAX))
    for axis, mode in ((0, "edge"), (1, "wrap")):
        width = [(reach, reach) if a == axis else (0, 0) for a in range(3)]
        padded = np.pad(tamed, width, mode=mode)  # type: ignore[call-overload]
        n = tamed.shape[axis]
        tamed = sum(w * padded.take(range(i, i + n), axis=axis) for i, w in enumerate(weights))
    return tamed.astype(np.float32)
