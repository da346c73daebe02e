"""Human skin with subsurface scattering, nails, and the cloth of a sleeve."""

import bpy
import numpy as np
from jaxtyping import Float
from PIL import Image

from datagen.blender.shading.images import add_drawn_image, add_image, coded_normals, decode_image
from datagen.blender.shading.nodes import Graph, Input, new_material, surface
from datagen.blender.shading.skin_relief import skin_relief, texel_size_m
from datagen.scene.scene import ARM_SKIN, HAND_SKIN, HandLook, HandSurface
from shards.color import linear_from_srgb

__all__ = ["ARM_BLEND", "ARM_COLOR", "REST", "arm_color_and_blend", "skin_materials", "sleeve_material"]

# Vertex attributes the materials read.
REST = "rest_m"  # position in the first frame: patterns stick to arm and cloth while they move
ARM_COLOR = "arm_color"  # linear colour of forearm skin, continued from the wrist
ARM_BLEND = "arm_blend"  # share of that colour: 1 on the forearm, 0 on the hand

# Mean free path of light in skin, metres, for red, green and blue (Jensen et al. 2001, "skin1").
_SCATTER_M = 0.00367
_SCATTER_RGB = (1.0, 0.373, 0.186)
_SKIN_IOR = 1.4

_GLOSS_RANGE = 0.08  # roughness changes by this much between dry and oily patches
_ARM_DRYER = 0.14  # added roughness: the forearm has no painted relief to break its highlights
_NAIL_ROUGHNESS = 0.14
_BORDER_M = 0.007  # of hand on the wrist's border that takes the forearm's colour
_TONE_BLUR_M = 0.012
_THREAD_M = 0.0012


def skin_materials(
    look: HandLook, topology: HandSurface, verts: Float[np.ndarray, "vert 3"], seed: int
) -> tuple[bpy.types.Material, bpy.types.Material]:
    """Skin of the hand and of the forearm; `verts` are those of the first frame, metres.

    Relief, gloss and nails are drawn into one texture beforehand: as shader nodes they doubled
    the cost of a hand's pixels. Raises TextureError when an image is damaged.
    """
    relief = _relief_image(look, topology, verts, seed)
    hand, graph = new_material("hand skin")
    texture = graph.image(add_image(look.skin_png, "skin colour", is_color=True)).outputs["Color"]
    color = graph.mix(graph.attribute(ARM_BLEND, "Fac"), texture, graph.attribute(ARM_COLOR, "Color"))
    _finish_skin(graph, look, color, relief, drier=0.0)

    arm, graph = new_material("arm skin")
    mottling = graph.noise(graph.attribute(REST, "Vector"), 90.0, detail=1.0)
    mottled = graph.mix(mottling, (0.90, 0.85, 0.83), (1.10, 1.12, 1.12))
    color = graph.mix(1.0, graph.attribute(ARM_COLOR, "Color"), mottled, blend="MULTIPLY")
    _finish_skin(graph, look, color, relief, drier=_ARM_DRYER)
    return hand, arm


def _finish_skin(graph: Graph, look: HandLook, color: Input, relief: bpy.types.Image, drier: float) -> None:
    drawn = graph.image(relief)
    normal = graph.node("ShaderNodeNormalMap", {"Color": drawn.outputs["Color"]}, uv_map="UVMap").outputs[0]
    surface(
        graph,
        {
            "Base Color": color,
            "Roughness": graph.math("ADD", drawn.outputs["Alpha"], drier, clamp=True),
            "IOR": _SKIN_IOR,
            "Specular IOR Level": 0.42,
            "Normal": normal,
            "Subsurface Weight": look.subsurface,
            "Subsurface Radius": _SCATTER_RGB,
            "Subsurface Scale": _SCATTER_M,
        },
        subsurface_method="BURLEY",  # looks the same as the random walk here, at a fifth of its cost
    )


def _relief_image(
    look: HandLook, topology: HandSurface, verts: Float[np.ndarray, "vert 3"], seed: int
) -> bpy.types.Image:
    """Normals in the colour, roughness in the alpha."""
    skin = decode_image(look.skin_png, "skin colour").convert("RGB")
    skin_rgb = np.array(skin)
    nails = None
    if look.nail_mask_png is not None:
        mask = decode_image(look.nail_mask_png, "nail mask").convert("L").resize(skin.size)
        nails = np.asarray(mask, np.float32) / np.float32(255.0)
    texel_m = texel_size_m(topology, verts, skin.size[0])
    relief = skin_relief(skin_rgb, nails, texel_m, np.random.default_rng(seed))
    roughness = look.skin_roughness - _GLOSS_RANGE * relief.gloss
    if nails is not None:
        glossy = look.skin_roughness + (_NAIL_ROUGHNESS - look.skin_roughness) * look.nail_gloss
        roughness = roughness + nails * (glossy - roughness)
    height_m = look.bump * relief.height_m[::-1]
    coded = np.concatenate(
        [coded_normals(height_m, texel_m), np.clip(roughness[::-1, :, None], 0.05, 1.0)], axis=-1
    )
    return add_drawn_image("skin relief", coded.astype(np.float32), is_color=False)


def sleeve_material(look: HandLook, axis: Float[np.ndarray, "3"]) -> bpy.types.Material:
    """Woven cloth around an arm along `axis` (unit vector in the first frame)."""
    material, graph = new_material("sleeve")
    rest = graph.attribute(REST, "Vector")
    along = graph.node("ShaderNodeVectorMath", {0: rest, 1: tuple(axis)}, operation="DOT_PRODUCT").outputs[
        "Value"
    ]
    thread = _THREAD_M * look.sleeve_weave
    # Threads across the arm, and a finer fibre noise: close up it is cloth, far away it is its mean.
    warp = graph.math("SINE", graph.math("MULTIPLY", along, 2.0 * np.pi / thread))
    fibre = graph.noise(rest, 0.9 / thread, detail=1.0)
    weave = graph.math(
        "ADD", graph.math("MULTIPLY", warp, 0.10 * thread), graph.math("MULTIPLY", fibre, 0.45 * thread)
    )
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
            "Normal": graph.bump(weave, 0.7),
        },
    )
    return material


def arm_color_and_blend(
    topology: HandSurface, verts: Float[np.ndarray, "vert 3"], look: HandLook
) -> tuple[Float[np.ndarray, "vert 3"], Float[np.ndarray, " vert"]]:
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
    """Linear colour of a texture at `uv`, averaged over 1/128 of its width."""
    small = decode_image(png, "skin colour").convert("RGB").resize((128, 128), Image.Resampling.BOX)
    srgb = np.asarray(small, np.float64)[::-1] / 255.0
    column, row = np.clip((uv * 128).astype(int), 0, 127).T
    return linear_from_srgb(srgb[row, column])
