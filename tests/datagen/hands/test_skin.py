"""Skin textures: HTML's decoding, the open basis against its sources, plausible draws."""

import json
import time
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.hands.builders.texel_map import map_texels
from datagen.hands.model import load_open_hand
from datagen.hands.skin import (
    SkinBasis,
    decode_skin,
    load_open_skin,
    open_nail_mask_png,
    sample_skin_coefficients,
)
from shards.storage.png import decode_png, encode_png

N_DRAWS = 200


@pytest.fixture(scope="module")
def skin() -> SkinBasis:
    return load_open_skin()


@pytest.fixture(scope="module")
def draws(skin: SkinBasis) -> np.ndarray:
    rng = np.random.default_rng(7)
    return np.stack([sample_skin_coefficients(rng, skin) for _ in range(N_DRAWS)])


@pytest.fixture(scope="module")
def mean_rgb(skin: SkinBasis, draws: np.ndarray) -> np.ndarray:
    """Mean colour of each draw; linear in the coefficients."""
    channels = [values.reshape(3, -1).mean(axis=1) for values in (skin.mean, *skin.basis.T)]
    return channels[0] + draws @ np.stack(channels[1:])


def _table() -> dict[str, Any]:
    return json.loads((files("datagen.hands") / "data" / "skin" / "skin.json").read_text())


def test_decoding_equals_the_definition_of_the_html_model() -> None:
    """Texel by texel, without the reshape and transpose of the function under test."""
    rng = np.random.default_rng(0)
    size, n = 8, 3
    index_map = rng.choice(3 * size**2, 100, replace=False)
    html = SkinBasis(
        name="html",
        size=size,
        mean=rng.uniform(-40.0, 300.0, 100),
        basis=rng.normal(size=(100, n)) * 20.0,
        index_map=index_map,
        axes=("",) * n,
        anchors=np.zeros((0, n)),
    )
    alpha = rng.normal(size=n)
    expected = np.zeros((size, size, 3), np.uint8)
    for value, index in zip(html.mean + html.basis @ alpha, index_map):
        channel, rest = divmod(int(index), size * size)
        column, row = divmod(rest, size)
        expected[row, column, channel] = np.uint8(np.clip(np.rint(value), 0, 255))
    np.testing.assert_array_equal(decode_skin(html, alpha), expected)


def test_decoding_refuses_the_wrong_number_of_coefficients(skin: SkinBasis) -> None:
    with pytest.raises(ValueError, match="takes 8 coefficients, found 101"):
        decode_skin(skin, np.zeros(101))


def test_basis_reproduces_the_mean_colour_of_every_source_skin(skin: SkinBasis) -> None:
    """After JPEG and quantisation; the whole images agree to 1.2 of 255 on average."""
    table = _table()
    assert len(skin.anchors) == len(table["mean_rgb"]) == 22
    used = _footprint(skin)
    for anchor, wanted in zip(skin.anchors, table["mean_rgb"].values()):
        texture = decode_skin(skin, anchor)
        assert np.abs(texture[used].mean(axis=0) - wanted).max() < 1.5
    assert max(table["fit_error"].values()) < 1.6


def _footprint(skin: SkinBasis) -> np.ndarray:
    inside = np.zeros(3 * skin.size**2, bool)
    inside[skin.index_map] = True
    return inside.reshape(3, skin.size, skin.size).transpose(2, 1, 0).all(axis=-1)


def test_footprint_covers_every_texel_the_hand_reads_with_a_margin(skin: SkinBasis) -> None:
    inside = map_texels(load_open_hand().corner_uv, skin.size).inside
    for shift in ((0, 0), (5, 0), (-5, 0), (0, 5), (0, -5)):
        moved = np.roll(inside, shift, axis=(0, 1))
        moved[:6], moved[-6:], moved[:, :6], moved[:, -6:] = False, False, False, False
        assert _footprint(skin)[moved].all()


def test_texture_does_not_change_towards_the_wrist_ring(skin: SkinBasis) -> None:
    """The painted border of the sources would draw a bracelet around the wrist."""
    hand = load_open_hand()
    texture = decode_skin(skin, np.zeros(skin.basis.shape[1])).astype(float)
    ring = np.isin(hand.faces, hand.wrist_loop)
    apex = np.setdiff1d(np.unique(hand.faces[ring.sum(axis=1) == 2]), hand.wrist_loop)
    cap = ring.sum(axis=1) == 2
    cap &= (hand.faces == apex[np.argmax([np.sum(hand.faces[cap] == a) for a in apex])]).any(axis=1)
    beside = ring.any(axis=1) & ~cap
    at_ring = _sample(texture, hand.corner_uv[beside][ring[beside]])
    inward = _sample(texture, hand.corner_uv[beside][~ring[beside]])
    assert np.abs(at_ring.mean(axis=0) - inward.mean(axis=0)).max() < 8.0


def _sample(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    size = len(texture)
    column, row = np.clip((uv * size).astype(int), 0, size - 1).T
    return texture[size - 1 - row, column]


def test_draws_reach_from_very_dark_to_very_light(mean_rgb: np.ndarray) -> None:
    """Individual typology angle of the mean colour: below -30 dark, above 41 light (Chardon 1991)."""
    L, _, b = _lab(mean_rgb).T
    angle_deg = np.degrees(np.arctan2(L - 50.0, b))
    assert np.percentile(angle_deg, 10) < -15.0
    assert np.percentile(angle_deg, 5) < -30.0
    assert np.percentile(angle_deg, 90) > 41.0
    assert np.mean((angle_deg > -15.0) & (angle_deg < 28.0)) > 0.1, "no gap between dark and light"


def test_draws_are_skin_colours_inside_the_gamut(
    skin: SkinBasis, draws: np.ndarray, mean_rgb: np.ndarray
) -> None:
    assert (np.diff(mean_rgb, axis=1) < 0.0).all(), "red > green > blue on every skin"
    L, a, b = _lab(mean_rgb).T
    hue_deg = np.degrees(np.arctan2(b, a))
    assert hue_deg.min() > 30.0
    assert hue_deg.max() < 80.0
    assert np.hypot(a, b).max() < 40.0
    assert L.min() > 8.0
    some = np.argsort(mean_rgb.sum(axis=1))[:: N_DRAWS // 8]
    clipped = [
        np.mean((v := skin.mean + skin.basis @ draws[k].astype(np.float32)) < 0) + np.mean(v > 255)
        for k in some
    ]
    assert max(clipped) < 0.02


def _lab(srgb: np.ndarray) -> np.ndarray:
    """CIE L*a*b* (D65) of sRGB 0..255."""
    c = srgb / 255.0
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = linear @ to_xyz.T / [0.9505, 1.0, 1.089]
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16.0 / 116.0)
    return np.stack(
        [116.0 * f[:, 1] - 16.0, 500.0 * (f[:, 0] - f[:, 1]), 200.0 * (f[:, 1] - f[:, 2])], axis=1
    )


def test_first_axes_mean_what_they_say(skin: SkinBasis) -> None:
    tone, _, undertone = (skin.basis[:, k].reshape(3, -1).mean(axis=1) for k in range(3))
    assert (tone > 20.0).all()
    assert undertone[0] > undertone[2]
    ages = np.array([("young", "middleage", "old").index(name.split("_")[0]) for name in _table()["anchors"]])
    assert np.corrcoef(ages, skin.anchors[:, 1])[0, 1] > 0.8
    assert [axis.split(":")[0] for axis in skin.axes[:3]] == ["tone", "age", "undertone"]


def test_drawing_is_a_function_of_the_generator(skin: SkinBasis) -> None:
    first, second = (sample_skin_coefficients(np.random.default_rng(3), skin) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert encode_png(decode_skin(skin, first)) == encode_png(decode_skin(skin, second))


def test_models_without_known_skins_draw_from_a_clipped_normal(skin: SkinBasis) -> None:
    foreign = SkinBasis(
        name="html",
        size=skin.size,
        mean=skin.mean,
        basis=skin.basis,
        index_map=skin.index_map,
        axes=("",) * skin.basis.shape[1],
        anchors=np.zeros((0, skin.basis.shape[1])),
    )
    rng = np.random.default_rng(0)
    coefficients = np.stack([sample_skin_coefficients(rng, foreign) for _ in range(500)])
    assert np.abs(coefficients).max() <= 2.0
    assert np.abs(coefficients.mean(axis=0)).max() < 0.2


def test_nails_are_a_gray_png_on_the_same_layout(skin: SkinBasis) -> None:
    image = decode_png(open_nail_mask_png())
    assert image.shape == (skin.size, skin.size)
    assert image.dtype == np.uint8


def test_nails_lie_at_the_tips_of_all_five_fingers() -> None:
    hand = load_open_hand()
    nails = decode_png(open_nail_mask_png())
    face = map_texels(hand.corner_uv, len(nails)).face
    on_nail = hand.v_template[hand.faces[np.unique(face[(nails > 128) & (face >= 0)])]].mean(axis=1)
    distance = np.linalg.norm(on_nail[:, None] - hand.v_template[hand.tip_ids], axis=-1)
    assert set(distance.argmin(axis=1)) == set(range(5))
    assert distance.min(axis=1).max() < 0.02


def test_package_data_is_small_and_loads_fast() -> None:
    folder = Path(str(files("datagen.hands") / "data"))
    assert sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) < 3e6
    load_open_skin.cache_clear()
    started = time.process_time()
    skin = load_open_skin()
    decode_skin(skin, skin.anchors[0])
    assert time.process_time() - started < 1.5
