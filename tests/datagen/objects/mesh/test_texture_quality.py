"""Texture quality orders objects as an eye would."""

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from datagen.objects.mesh.object_mesh import Material
from datagen.objects.mesh.texture_quality import measure_texture_quality


def textured(mesh, pixels: np.ndarray):
    buffer = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(buffer, format="PNG")
    image = Material(name="image", base_color_rgba=(1.0, 1.0, 1.0, 1.0), base_color_image=buffer.getvalue())
    u_v = (mesh.verts_obj[mesh.faces][..., :2] + 0.05) / 0.1
    return replace(mesh, corner_uv=u_v, materials=(image,))


@pytest.fixture
def mesh(box, plain_mesh):
    return plain_mesh(*box)


def test_plain_colour_is_zero(mesh):
    quality = measure_texture_quality(mesh)
    assert quality.texture_resolution_px == 0
    assert quality.color_detail == 0


def test_more_detail_scores_higher(mesh):
    rng = np.random.default_rng(0)
    plain = measure_texture_quality(textured(mesh, np.full((256, 256, 3), 128)))
    ramp = np.linspace(0, 255, 256)[None, :, None] * np.ones((256, 1, 3))
    gradient = measure_texture_quality(textured(mesh, ramp))
    noise = measure_texture_quality(textured(mesh, rng.integers(0, 256, (256, 256, 3))))
    assert plain.color_detail == 0
    assert plain.color_detail < gradient.color_detail < noise.color_detail <= 1
    assert noise.color_detail > 0.9


def test_resolution_counts_texels_on_the_surface(mesh):
    small = measure_texture_quality(textured(mesh, np.zeros((64, 64, 3))))
    large = measure_texture_quality(textured(mesh, np.zeros((512, 512, 3))))
    assert large.texture_resolution_px == pytest.approx(8 * small.texture_resolution_px, rel=0.02)
    assert 0 < large.texture_resolution_px <= 512


def test_measure_is_deterministic(mesh):
    image = np.random.default_rng(1).integers(0, 256, (64, 64, 3))
    assert measure_texture_quality(textured(mesh, image)) == measure_texture_quality(textured(mesh, image))
