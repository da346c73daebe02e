"""Human skin with subsurface scattering, nails, and the cloth of a sleeve."""

import bpy
import numpy as np
from jaxtyping import Float
from PIL import Image

from datagen.blender.images import add_image, decode_image
from datagen.blender.nodes import Graph, Input, new_material, surface
from datagen.scene import ARM_SKIN, HAND_SKIN, HandLook, HandSurface

__all__ = ["ARM_BLEND", "ARM_COLOR", "REST", "arm_color_and_blend", "skin_material", "sleeve_material"]

# Vertex attributes the materials read.
REST = "rest_m"  # position in the first frame: relief sticks to the skin while the hand moves
ARM_COLOR = "arm_color"  # linear colour of forearm skin, continued from the wrist
ARM_BLEND = "arm_blend"  # share of that colour in the forearm, 0 on the hand

# Mean free path of light in skin, metres, for red, green and blue (Jensen et al. 2001, "skin1").
_SCATTER_M = 0.00367
_SCATTER_RGB = (1.0, 0.373, 0.186)
_SKIN_IOR = 1.4

# Depth of the relief in metres at HandLook.bump = 1.
_CREASE_M = 0.0009  # per unit of texture brightness: painted creases become relief
_WRINKLE_M = 0.00035
_PORE_M = 0.00012

_ARM_DRYER = 0.14  # added roughness: the hand's texture carries relief, the forearm is plain
_THREAD_M = 0.0012
_BORDER_M = 0.007  # of hand on the wrist's border that takes the forearm's colour
_TONE_BLUR_M = 0.012


def skin_material(look: HandLook) -> bpy.types.Material:
    """Skin of hand and forearm. Raises TextureError when an image is damaged."""
    material, graph = new_material("skin")
    rest = graph.attribute(REST, "Vector")
    texture = graph.image(add_image(look.skin_png, "skin colour", is_color=True)).outputs["Color"]
    blend = graph.attribute(ARM_BLEND, "Fac")
    mottled = graph.mix(graph.noise(rest, 110.0, detail=3.0), (0.90, 0.85, 0.83), (1.10, 1.12, 1.12))
    arm = graph.mix(1.0, graph.attribute(ARM_COLOR, "Color"), mottled, blend="MULTIPLY")
    color = graph.mix(blend, texture, arm)

    pores = graph.node("ShaderNodeTexVoronoi", {"Vector": rest, "Scale": 1100.0}).outputs["Distance"]
    wrinkles = graph.noise(rest, 420.0, detail=3.0, roughness=0.6)
    nail = _nail_mask(graph, look)
    height = _height(graph, texture, blend, wrinkles, pores)
    roughness = graph.math("ADD", look.skin_roughness, graph.remap(wrinkles, 0.3, 0.7, 0.07, -0.07))
    smear = graph.remap(graph.noise(rest, 28.0), 0.3, 0.7, -0.06, 0.06)  # oily and dry patches
    roughness = graph.math("ADD", roughness, smear)
    roughness = graph.math("ADD", roughness, graph.math("MULTIPLY", blend, _ARM_DRYER), clamp=True)
    if nail is not None:
        glossy = look.skin_roughness + (0.12 - look.skin_roughness) * look.nail_gloss
        roughness = graph.math("ADD", roughness, graph.math("MULTIPLY", nail, graph.math("SUBTRACT", glossy, roughness)))
        height = graph.math("MULTIPLY", height, graph.math("SUBTRACT", 1.0, nail))
    surface(
        graph,
        {
            "Base Color": color,
            "Roughness": roughness,
            "IOR": _SKIN_IOR,
            "Specular IOR Level": 0.42,
            "Normal": graph.bump(height, look.bump),
            "Subsurface Weight": look.subsurface,
            "Subsurface Radius": _SCATTER_RGB,
            "Subsurface Scale": _SCATTER_M,
            "Sheen Weight": 0.03,
            "Sheen Roughness": 0.4,
        },
        subsurface_method="RANDOM_WALK_SKIN",
    )
    return material


def _height(graph: Graph, texture: Input, blend: Input, wrinkles: Input, pores: Input) -> bpy.types.NodeSocket:
    brightness = graph.node("ShaderNodeRGBToBW", {0: texture}).outputs[0]
    on_hand = graph.math("SUBTRACT", 1.0, blend)
    crease = graph.math("MULTIPLY", graph.math("MULTIPLY", brightness, on_hand), _CREASE_M)
    fine = graph.math("ADD", graph.math("MULTIPLY", wrinkles, _WRINKLE_M), graph.math("MULTIPLY", pores, _PORE_M))
    return graph.math("ADD", crease, fine)


def _nail_mask(graph: Graph, look: HandLook) -> bpy.types.NodeSocket | None:
    if look.nail_mask_png is None:
        return None
    return graph.image(add_image(look.nail_mask_png, "nail mask", is_color=False)).outputs["Color"]


def sleeve_material(look: HandLook, axis: Float[np.ndarray, "3"]) -> bpy.types.Material:
    """Woven cloth around an arm along `axis` (unit vector in the first frame)."""
    material, graph = new_material("sleeve")
    rest = graph.attribute(REST, "Vector")
    along = graph.node("ShaderNodeVectorMath", {0: rest, 1: tuple(axis)}, operation="DOT_PRODUCT").outputs["Value"]
    thread = _THREAD_M * look.sleeve_weave
    # Threads across the arm, and a finer fibre noise: close up it is cloth, far away it is its mean.
    warp = graph.math("SINE", graph.math("MULTIPLY", along, 2.0 * np.pi / thread))
    fibre = graph.noise(rest, 0.9 / thread, detail=2.0)
    folds = graph.noise(rest, 55.0, detail=2.0)
    weave = graph.math("ADD", graph.math("MULTIPLY", warp, 0.10 * thread), graph.math("MULTIPLY", fibre, 0.45 * thread))
    height = graph.math("ADD", weave, graph.math("MULTIPLY", folds, 0.004))
    worn = graph.remap(fibre, 0.25, 0.75, 0.82, 1.12)
    color = graph.mix(1.0, look.sleeve_color_rgb, graph.combine(worn, worn, worn), blend="MULTIPLY")
    surface(
        graph,
        {
            "Base Color": color,
            "Roughness": 0.85,
            "Specular IOR Level": 0.25,
            "Sheen Weight": 0.35,
            "Sheen Roughness": 0.5,
            "Sheen Tint": look.sleeve_color_rgb,
            "Normal": graph.bump(height, 0.7),
        },
    )
    return material


def arm_color_and_blend(
    topology: HandSurface, verts: Float[np.ndarray, "vert 3"], look: HandLook
) -> tuple[Float[np.ndarray, "vert 3"], Float[np.ndarray, "vert"]]:
    """Colour that continues the skin of the wrist along the forearm, and where it applies.

    A forearm vertex takes the colour of the nearest hand vertices that lie clear of the wrist's
    border (textures are often pale there), so palm side and back keep their tones. The border
    itself is crossed smoothly on the hand's side. `verts` are those of the first frame.
    """
    hand_corners = topology.faces[topology.face_part == HAND_SKIN].reshape(-1)
    hand, first = np.unique(hand_corners, return_index=True)
    hand_uv = topology.corner_uv[topology.face_part == HAND_SKIN].reshape(-1, 2)[first]
    arm = np.unique(topology.faces[topology.face_part == ARM_SKIN])
    color, blend = np.zeros((len(verts), 3)), np.zeros(len(verts))
    border = np.intersect1d(hand, arm)
    if not len(border):
        return color, blend

    to_border = _distances(verts[hand], verts[border]).min(axis=1)
    blend[hand] = np.clip(1.0 - (to_border - _BORDER_M) / _BORDER_M, 0.0, 1.0)
    blend[arm] = 1.0
    colored = np.flatnonzero(blend)
    clear = to_border > 2.0 * _BORDER_M
    distance = _distances(verts[colored], verts[hand[clear]])
    farther = distance - distance.min(axis=1, keepdims=True)
    weight = np.exp(-0.5 * (farther / _TONE_BLUR_M) ** 2)
    color[colored] = weight @ _sample(look.skin_png, hand_uv[clear]) / weight.sum(axis=1, keepdims=True)
    return color, blend


def _distances(a: Float[np.ndarray, "m 3"], b: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m n"]:
    return np.linalg.norm(a[:, None] - b[None], axis=-1)


def _sample(png: bytes, uv: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "point 3"]:
    """Linear colour of a texture at `uv`, averaged over about 1/128 of its width."""
    small = decode_image(png, "skin colour").convert("RGB").resize((128, 128), Image.Resampling.BOX)
    srgb = np.asarray(small, np.float64)[::-1] / 255.0
    column, row = np.clip((uv * 128).astype(int), 0, 127).T
    value = srgb[row, column]
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
