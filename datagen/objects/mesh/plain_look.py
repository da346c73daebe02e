"""A plausible look for shapes that come without one: material, colour and a faint grain.

Everything is drawn from the name of the object, so it looks the same at every size and in every
clip. The image tiles, and is laid on by projection along each face's main axis.
"""

import colorsys
import hashlib
import io
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from PIL import Image

from datagen.objects.mesh.object_mesh import Material, ObjectMesh
from datagen.objects.mesh.surface_points import face_normals
from shards.color import linear_from_srgb, srgb_from_linear

__all__ = ["with_plain_look"]

IMAGE_PX = 256
TILE_M = 0.12  # the image covers a square this wide
# sRGB base colours of polished steel, aluminium, brass, copper and gunmetal
METALS = ((0.62, 0.61, 0.60), (0.80, 0.80, 0.82), (0.82, 0.68, 0.36), (0.80, 0.49, 0.36), (0.33, 0.34, 0.37))
# light and dark grain of birch, oak, walnut and cherry, sRGB
WOODS = (
    ((0.86, 0.74, 0.56), (0.76, 0.61, 0.42)),
    ((0.71, 0.52, 0.32), (0.56, 0.38, 0.21)),
    ((0.43, 0.28, 0.18), (0.30, 0.18, 0.11)),
    ((0.65, 0.36, 0.22), (0.50, 0.25, 0.14)),
)

Color = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class _Look:
    """Two sRGB colours that the grain mixes, and how the surface shines."""

    name: str
    light: Color
    dark: Color
    grain: Float[np.ndarray, "row column"] | None  # 0..1, tiling; None: the light colour alone
    metallic: float
    roughness: float


def with_plain_look(mesh: ObjectMesh, name: str) -> ObjectMesh:
    """The mesh in one generated material, chosen by `name` alone. UVs and colours are replaced."""
    digest = hashlib.sha256(f"plain look {name}".encode()).digest()
    rng = np.random.default_rng(int.from_bytes(digest[:8], "little"))
    look = LOOKS[int(rng.integers(len(LOOKS)))](rng)
    plain = look.grain is None
    material = Material(
        name=look.name,
        base_color_rgba=(*_linear(look.light), 1.0) if plain else (1.0, 1.0, 1.0, 1.0),
        base_color_image=None if look.grain is None else _image(look.light, look.dark, look.grain),
        metallic=look.metallic,
        roughness=look.roughness,
    )
    return replace(
        mesh,
        corner_uv=_box_projected(mesh),
        more_corner_uv=(),
        corner_colors=None,
        face_material=np.zeros(len(mesh.faces), dtype=np.int64),
        materials=(material,),
    )


def _box_projected(mesh: ObjectMesh) -> Float[np.ndarray, "face 3 2"]:
    """Corner positions without the coordinate that the face looks along, in tiles."""
    axis = np.abs(face_normals(mesh.verts_obj, mesh.faces)).argmax(axis=1)
    others = np.array([[1, 2], [0, 2], [0, 1]])[axis]  # z stays vertical in the image
    corners = mesh.verts_obj[mesh.faces]
    return np.take_along_axis(corners, np.broadcast_to(others[:, None], (len(axis), 3, 2)), axis=2) / TILE_M


def _linear(color: Color) -> Color:
    r, g, b = linear_from_srgb(np.array(color))
    return float(r), float(g), float(b)


def _image(light: Color, dark: Color, grain: Float[np.ndarray, "row column"]) -> bytes:
    mixed = np.array(_linear(light)) + grain[..., None] * (np.array(_linear(dark)) - np.array(_linear(light)))
    buffer = io.BytesIO()
    Image.fromarray(np.round(srgb_from_linear(mixed) * 255).astype(np.uint8)).save(buffer, format="PNG")
    return buffer.getvalue()


def _noise(rng: np.random.Generator, wavelengths: tuple[float, float]) -> Float[np.ndarray, "row column"]:
    """Tiling noise of standard deviation 1, smooth below the wavelengths (rows, columns) in pixels."""
    frequency = np.fft.fftfreq(IMAGE_PX)
    falloff = np.exp(-0.5 * ((frequency[:, None] * wavelengths[0]) ** 2 + (frequency * wavelengths[1]) ** 2))
    falloff[0, 0] = 0.0
    noise = np.fft.ifft2(np.fft.fft2(rng.standard_normal((IMAGE_PX, IMAGE_PX))) * falloff).real
    return noise / noise.std()


def _paint(rng: np.random.Generator, saturation: tuple[float, float]) -> Color:
    """A colour as things are painted: a third are white, grey or black."""
    if rng.random() < 1 / 3:
        grey = float(rng.choice([0.92, 0.85, 0.55, 0.30, 0.12])) + float(rng.uniform(-0.03, 0.03))
        return grey, grey, grey
    hue, chroma, value = rng.random(), rng.uniform(*saturation), rng.uniform(0.35, 0.9)
    return colorsys.hsv_to_rgb(float(hue), float(chroma), float(value))


def _darker(color: Color, factor: float) -> Color:
    return color[0] * factor, color[1] * factor, color[2] * factor


def _glazed_ceramic(rng: np.random.Generator) -> _Look:
    color = _paint(rng, (0.1, 0.6))
    speckles = np.clip(_noise(rng, (6.0, 6.0)) - 1.8, 0.0, 1.0)
    roughness = float(rng.uniform(0.08, 0.25))
    return _Look(
        name="glazed_ceramic",
        light=color,
        dark=_darker(color, 0.45),
        grain=speckles,
        metallic=0.0,
        roughness=roughness,
    )


def _painted_wood(rng: np.random.Generator) -> _Look:
    color = _paint(rng, (0.3, 0.8))
    grain = np.clip(0.5 + 0.25 * _noise(rng, (120.0, 6.0)), 0.0, 1.0)
    roughness = float(rng.uniform(0.35, 0.6))
    return _Look(
        name="painted_wood",
        light=color,
        dark=_darker(color, 0.8),
        grain=grain,
        metallic=0.0,
        roughness=roughness,
    )


def _varnished_wood(rng: np.random.Generator) -> _Look:
    light, dark = WOODS[int(rng.integers(len(WOODS)))]
    # Rings cut lengthwise: bands along the columns, bent by slow noise; they tile as 8 is whole.
    bands = 8.0 * np.arange(IMAGE_PX) / IMAGE_PX + 0.35 * _noise(rng, (90.0, 40.0))
    grain = np.clip(0.5 + 0.35 * np.sin(2 * np.pi * bands) + 0.15 * _noise(rng, (60.0, 3.0)), 0.0, 1.0)
    roughness = float(rng.uniform(0.3, 0.55))
    return _Look(
        name="varnished_wood", light=light, dark=dark, grain=grain, metallic=0.0, roughness=roughness
    )


def _matt_plastic(rng: np.random.Generator) -> _Look:
    color, roughness = _paint(rng, (0.4, 0.95)), float(rng.uniform(0.4, 0.7))
    return _Look(name="matt_plastic", light=color, dark=color, grain=None, metallic=0.0, roughness=roughness)


def _rubber(rng: np.random.Generator) -> _Look:
    color, roughness = _darker(_paint(rng, (0.2, 0.7)), 0.6), float(rng.uniform(0.7, 0.95))
    return _Look(name="rubber", light=color, dark=color, grain=None, metallic=0.0, roughness=roughness)


def _metal(rng: np.random.Generator) -> _Look:
    color = METALS[int(rng.integers(len(METALS)))]
    scratches = np.clip(0.5 + 0.25 * _noise(rng, (2.0, 80.0)), 0.0, 1.0)
    roughness = float(rng.uniform(0.25, 0.5))
    return _Look(
        name="metal",
        light=color,
        dark=_darker(color, 0.85),
        grain=scratches,
        metallic=1.0,
        roughness=roughness,
    )


LOOKS: tuple[Callable[[np.random.Generator], _Look], ...] = (
    _glazed_ceramic,
    _painted_wood,
    _varnished_wood,
    _matt_plastic,
    _rubber,
    _metal,
)
