"""Relief and gloss of skin as textures in the hand's own UV layout. Knows nothing of Blender."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from datagen.scene.scene import HAND_SKIN, HandSurface

__all__ = ["SkinRelief", "skin_relief", "texel_size_m"]

# Depth of the relief in metres at HandLook.bump = 1.
_CREASE_M = 0.0011  # per unit of painted brightness: painted creases and knuckles become relief
_LINE_M = 0.000045
_PORE_M = 0.00003
_CREASE_WIDTH_M = 0.004  # what is broader is shading or colour, not relief

Field = Float32[np.ndarray, "row column"]


@dataclass(frozen=True, kw_only=True)
class SkinRelief:
    """Maps in image order: the first row is the top of the texture."""

    height_m: Field
    gloss: Field  # -1..1: dry to oily


def texel_size_m(topology: HandSurface, verts: Float[np.ndarray, "vert 3"], texture_px: int) -> float:
    """Mean size of a texel on the hand, metres; `verts` are those of one frame."""
    hand = topology.face_part == HAND_SKIN
    corners, uv = verts[topology.faces[hand]], topology.corner_uv[hand]
    edges, uv_edges = corners[:, 1:] - corners[:, :1], uv[:, 1:] - uv[:, :1]
    area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=-1).sum()
    uv_area = (
        0.5 * np.abs(uv_edges[:, 0, 0] * uv_edges[:, 1, 1] - uv_edges[:, 0, 1] * uv_edges[:, 1, 0]).sum()
    )
    if not uv_area > 0.0:
        raise ValueError("hand surface: the UV map of the hand has no area; skin cannot be drawn on it")
    return float(np.sqrt(area / uv_area) / texture_px)


def skin_relief(
    skin_rgb: UInt8[np.ndarray, "row column 3"], nails: Field | None, texel_m: float, rng: np.random.Generator
) -> SkinRelief:
    """Creases from the painted skin, plus fine lines and pores; nails (1 inside) stay smooth."""
    brightness = cv2.cvtColor(skin_rgb, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255.0
    painted = (brightness > 0.0).astype(np.float32)  # textures are black where no skin is mapped
    broad_px = _CREASE_WIDTH_M / texel_m
    broad = cv2.GaussianBlur(brightness, (0, 0), broad_px) / np.maximum(
        cv2.GaussianBlur(painted, (0, 0), broad_px), 0.05
    )
    crease = cv2.GaussianBlur(brightness - broad, (0, 0), 0.8) * cv2.erode(painted, np.ones((5, 5), np.uint8))

    shape = brightness.shape
    lines = _noise(rng, shape, 0.0016 / texel_m) + 0.7 * _noise(rng, shape, 0.0008 / texel_m)
    pores = np.minimum(_noise(rng, shape, 0.0009 / texel_m) + 0.6, 0.0)
    height = _CREASE_M * np.clip(crease, -0.25, 0.12) + _LINE_M * lines + _PORE_M * pores
    oily = np.tanh(0.7 * _noise(rng, shape, 0.025 / texel_m) + 0.4 * _noise(rng, shape, 0.003 / texel_m))
    if nails is not None:
        height *= 1.0 - nails
    return SkinRelief(height_m=height.astype(np.float32), gloss=oily.astype(np.float32))


def _noise(rng: np.random.Generator, shape: tuple[int, ...], size_px: float) -> Field:
    """Smooth noise with features of `size_px`, mean 0, deviation about 1."""
    cells = [max(4, int(np.ceil(n / max(size_px, 1.5))) + 3) for n in shape]
    lattice = rng.standard_normal(cells, dtype=np.float32)
    return 1.5 * cv2.resize(lattice, shape[::-1], interpolation=cv2.INTER_CUBIC)
