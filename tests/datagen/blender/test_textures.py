"""Drawn textures: pure functions of their seeds, in range, and metric."""

import dataclasses

import numpy as np
import pytest

from datagen.blender.shading.skin_relief import skin_relief, texel_size_m
from datagen.blender.shading.table_textures import draw_table
from datagen.scene.scene import HandSurface


@pytest.mark.parametrize("material", ["wood", "stone", "cloth", "laminate"])
def test_tables_are_drawn_from_their_seed_within_range(material, box_scene):
    table = dataclasses.replace(box_scene.table, material=material)
    drawn, again = draw_table(table), draw_table(table)
    other = draw_table(dataclasses.replace(table, pattern_seed=4))
    np.testing.assert_array_equal(drawn.color, again.color)
    assert np.abs(drawn.color - other.color).max() > 0.01
    assert drawn.color.shape[:2] == (round(0.4 / drawn.texel_m), round(0.5 / drawn.texel_m))
    for field in (drawn.color, drawn.roughness):
        assert field.min() >= 0.0
        assert field.max() <= 1.0
    assert np.abs(drawn.height_m).max() < 0.006
    # Between its two colours, apart from shade: neither may vanish from a two-tone pattern.
    assert drawn.color.std() > 0.005


def test_a_texel_is_measured_on_the_hand():
    square = HandSurface(
        faces=np.array([[0, 1, 2], [0, 2, 3]]),
        corner_uv=np.array([[[0.0, 0.0], [0.5, 0.0], [0.5, 0.5]], [[0.0, 0.0], [0.5, 0.5], [0.0, 0.5]]]),
        face_part=np.zeros(2, int),
        n_hand_verts=4,
    )
    verts = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.1, 0.1, 0.0], [0.0, 0.1, 0.0]])
    assert texel_size_m(square, verts, 1000) == pytest.approx(0.1 / 500)


def test_a_hand_without_texture_coordinates_is_refused(box_scene):
    scene = box_scene
    flat = dataclasses.replace(scene.hand_surface, corner_uv=np.zeros_like(scene.hand_surface.corner_uv))
    with pytest.raises(ValueError, match="UV map of the hand has no area"):
        texel_size_m(flat, scene.hand_verts_world[0], 1024)


def test_nails_are_smooth_and_skin_is_not():
    rng = np.random.default_rng(0)
    skin = rng.integers(120, 180, (128, 128, 3), dtype=np.uint8)
    nails = np.zeros((128, 128), np.float32)
    nails[:32, :32] = 1.0
    relief = skin_relief(skin, nails, 0.0003, np.random.default_rng(1))
    assert np.all(relief.height_m[:32, :32] == 0.0)
    assert relief.height_m[40:].std() > 1e-5
    assert np.abs(relief.gloss).max() <= 1.0
