"""Light levels add up whatever is drawn, lamps are black bodies, tables and looks are plausible."""

from dataclasses import replace

import numpy as np
import pytest

from datagen.sampling.appearance import sample_arm_style, sample_betas, sample_look
from datagen.sampling.lights import blackbody_rgb, lamp_power_w, sample_light
from datagen.sampling.tables import TableConfig, sample_table


def draw(config, seed):
    return sample_light(
        config, np.array([0.1, 0.2, 0.3]), np.random.default_rng(seed), np.random.default_rng(seed + 1000)
    )


def test_environment_and_key_lamp_make_up_the_card_level(config):
    lights = config.lights
    seen = set()
    for seed in range(200):
        lamps, background = draw(lights, seed)
        key = lamps[0]
        distance = np.linalg.norm(key.position_world - np.array([0.1, 0.2, 0.3]))
        level = key.power_w / (np.pi * distance) ** 2 + background.strength
        assert lights.card_level[0] - 1e-9 <= level <= lights.card_level[1] + 1e-9
        assert lights.n_lamps[0] <= len(lamps) <= lights.n_lamps[1]
        assert all(0.0 < lamp.power_w <= key.power_w * 3.0 * 2.0 for lamp in lamps)
        seen.add(background.hdri)
    assert seen == set(lights.hdris)


def test_a_dark_environment_leaves_the_light_to_the_lamps(config):
    nights = [draw(replace(config.lights, hdris={"night": 0.35}), seed)[1].strength for seed in range(50)]
    days = [draw(replace(config.lights, hdris={"city": 1.0}), seed)[1].strength for seed in range(50)]
    np.testing.assert_allclose(nights, 0.35 * np.array(days))


def test_lamp_power_follows_the_square_of_the_distance():
    # Cycles 4.5 measured: 100 W, 0.3 m wide, 2 m away lights a white card to 2.514.
    assert abs(100.0 / lamp_power_w(2.514, 2.0) - 1.0) < 0.01
    assert abs(lamp_power_w(1.0, 2.0) / lamp_power_w(1.0, 1.0) - 4.0) < 1e-12


def test_black_bodies_run_from_orange_to_blue_at_equal_luminance():
    for kelvin in (1700.0, 2222.0, 2856.0, 4000.0, 4001.0, 6504.0, 12000.0):
        rgb = np.array(blackbody_rgb(kelvin))
        assert abs(rgb @ [0.2126, 0.7152, 0.0722] - 1.0) < 1e-12
        assert rgb.min() >= 0.0
    np.testing.assert_allclose(blackbody_rgb(6504.0), 1.0, atol=0.06)  # nearly the white of sRGB
    ratio = [blackbody_rgb(k)[0] / max(blackbody_rgb(k)[2], 1e-9) for k in (2500.0, 4000.0, 6500.0, 10000.0)]
    assert all(np.diff(ratio) < 0)
    with pytest.raises(ValueError, match="1667"):
        blackbody_rgb(900.0)


def test_tables_are_plausible_and_large_enough(config):
    rng = np.random.default_rng(0)
    materials = set()
    for _ in range(200):
        table = sample_table(
            config.table, rng, top_z_m=0.2, under_xy_m=(1.0, -2.0), footprint_m=0.3, edge=None
        )
        c, s = np.cos(table.yaw_rad), np.sin(table.yaw_rad)
        local = np.array([[c, s], [-s, c]]) @ (np.array([1.0, -2.0]) - table.center_xy_m)
        assert np.all(np.abs(local) + 0.3 < 0.5 * np.array(table.size_xy_m))
        colors = np.array([table.color_a_rgb, table.color_b_rgb])
        assert 0.0 < colors.min() <= colors.max() <= 0.9
        materials.add(table.material)
    assert materials == {"wood", "stone", "cloth", "laminate"}


@pytest.mark.parametrize("materials", [{}, {"wood": 0.0}, {"glass": 1.0}])
def test_unusable_table_materials_are_refused(config, materials):
    with pytest.raises(ValueError, match="wood, stone, cloth, laminate"):
        TableConfig(**{**config.table.__dict__, "materials": materials})


def test_looks_stay_in_their_ranges(config, skins):
    looks = config.appearance
    for seed in range(50):
        rng = np.random.default_rng(seed)
        assert np.abs(sample_betas(rng, looks)).max() <= 2.0 * looks.betas_std
        style = sample_arm_style(rng, looks)
        assert looks.forearm_length_m[0] <= style.length_m <= looks.forearm_length_m[1]
        assert style.sleeve_start_m is None or style.sleeve_start_m <= 0.6 * style.length_m
        look = sample_look(skins, looks, rng, rng)
        assert looks.bump[0] <= look.bump <= looks.bump[1]
        assert look.nail_mask_png is None  # the nails of another layout are not known
        assert 0.0 <= min(look.sleeve_color_rgb) <= max(look.sleeve_color_rgb) <= 1.0
        assert look.skin_png.startswith(b"\x89PNG")
