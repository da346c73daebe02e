"""Wrap modes, emission and tints of stored meshes, against boards whose images need none of it."""

import json
import struct
from itertools import product
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from model.structured_latent.object_features.object_mesh import textured_mesh
from model.structured_latent.object_features.object_views import object_views
from shards.color import linear_from_srgb, srgb_from_linear

CODES = {"repeat": 10497, "mirror": 33648, "clamp": 33071}
TEXELS = np.random.default_rng(0).integers(0, 256, (4, 4, 3), dtype=np.uint8)
OTHER = np.random.default_rng(1).integers(0, 256, (4, 4, 3), dtype=np.uint8)
CORNERS = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])  # Y up


def board(low: float, high: float, *, tint: tuple[float, ...] | None = None, **look: Any) -> bytes:
    """A square whose UVs run from low to high."""
    shape = trimesh.Trimesh(
        vertices=CORNERS,
        faces=[[0, 1, 2], [0, 2, 3]],
        visual=trimesh.visual.TextureVisuals(
            uv=(CORNERS[:, :2] + 0.5) * (high - low) + low,
            material=trimesh.visual.material.PBRMaterial(**look),
        ),
        process=False,
    )
    if tint is not None:
        shape.vertex_attributes["_COLOR_0"] = np.tile(np.array(tint, np.float32), (4, 1))
    exported = shape.export(file_type="glb")
    assert isinstance(exported, bytes)
    return exported.replace(b"_COLOR_0", b"COLOR_0 ").replace(b'"COLOR_0 "', b'"COLOR_0" ')


def with_wraps(glb: bytes, *codes: int) -> bytes:
    """The same file; the n-th texture repeats as the n-th pair of codes says."""
    (length,) = struct.unpack_from("<I", glb, 12)
    document = json.loads(glb[20 : 20 + length])
    document["samplers"] = [{"wrapS": s, "wrapT": t} for s, t in zip(codes[::2], codes[1::2])]
    for index, texture in enumerate(document["textures"]):
        texture["sampler"] = min(index, len(document["samplers"]) - 1)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = glb[20 + length :]
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest


def images(glb: bytes) -> np.ndarray:
    mesh = textured_mesh(glb, np.eye(4), where="board")
    return np.stack([view.image for view in object_views(mesh, 3, 64, 1)]).astype(int)


def image(pixels: np.ndarray) -> Image.Image:
    return Image.fromarray(pixels)


def expanded(wrap_u: str, wrap_v: str) -> np.ndarray:
    """What is seen from -2 to 3 on both axes; v grows upward, rows downward."""

    def rows(pixels: np.ndarray, wrap: str) -> np.ndarray:
        if wrap == "repeat":
            return np.concatenate([pixels] * 5)
        if wrap == "mirror":
            return np.concatenate([pixels, pixels[::-1], pixels, pixels[::-1], pixels])
        return np.pad(pixels, ((8, 8), (0, 0), (0, 0)), mode="edge")

    return rows(rows(TEXELS, wrap_v).transpose(1, 0, 2), wrap_u).transpose(1, 0, 2)


@pytest.mark.parametrize(("wrap_u", "wrap_v"), list(product(CODES, CODES)))
def test_wrap_modes_of_each_axis(wrap_u: str, wrap_v: str) -> None:
    glb = with_wraps(board(-1, 2, baseColorTexture=image(TEXELS)), CODES[wrap_u], CODES[wrap_v])
    large = board(0.2, 0.8, baseColorTexture=image(expanded(wrap_u, wrap_v)))
    ours, expected = images(glb), images(large)
    assert ours.std() > 20
    assert np.abs(ours - expected).max() <= 1


def test_baked_light_is_the_colour_of_what_is_black() -> None:
    black = board(
        0,
        1,
        baseColorFactor=[0, 0, 0, 255],
        emissiveTexture=image(TEXELS),
        emissiveFactor=[1.0, 1.0, 1.0],
    )
    np.testing.assert_array_equal(images(black), images(board(0, 1, baseColorTexture=image(TEXELS))))


def test_the_brighter_of_both_is_seen() -> None:
    both = board(
        0, 1, baseColorTexture=image(TEXELS), emissiveTexture=image(OTHER), emissiveFactor=[0.5, 0.5, 0.5]
    )
    linear = np.maximum(linear_from_srgb(TEXELS / 255.0), 0.5 * linear_from_srgb(OTHER / 255.0))
    expected = np.round(255 * srgb_from_linear(linear)).astype(np.uint8)
    np.testing.assert_array_equal(images(both), images(board(0, 1, baseColorTexture=image(expected))))


def test_images_that_lie_otherwise_are_left_out() -> None:
    both = board(
        0, 1, baseColorTexture=image(TEXELS), emissiveTexture=image(OTHER), emissiveFactor=[1.0, 1.0, 1.0]
    )
    apart = with_wraps(both, 10497, 10497, 33071, 33071)
    np.testing.assert_array_equal(images(apart), images(board(0, 1, baseColorTexture=image(TEXELS))))


def test_tints_multiply_the_texture() -> None:
    tinted = images(board(0, 1, baseColorTexture=image(np.full_like(TEXELS, 255)), tint=(0.5, 0.2, 1.0)))
    assert tinted[tinted.any(axis=-1)].std(axis=0).max() < 40  # light alone varies
    lit = tinted[tinted.any(axis=-1)].max(axis=0) / 255
    ratio = linear_from_srgb(lit) / linear_from_srgb(lit)[2]
    np.testing.assert_allclose(ratio, [0.5, 0.2, 1.0], atol=0.05)
