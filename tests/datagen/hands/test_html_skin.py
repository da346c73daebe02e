"""HTML files of the official layout: decoding, both hands, no dark seams, one line per broken file."""

import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.hands.html_skin import HtmlSkin, load_html_skin
from datagen.hands.mano import load_mano
from datagen.hands.model import HandModel, load_open_hand, mirror_hand
from datagen.hands.skin import SkinBasis, decode_skin, load_open_skin, sample_skin_coefficients
from datagen.input_error import InputError
from tests.datagen.hands.official_files import texture_lookup, uncapped, write_html, write_mano

PX = 64


@pytest.fixture(scope="module")
def right() -> HandModel:
    return uncapped(load_open_hand())


@pytest.fixture(scope="module")
def tight_skin(right: HandModel) -> SkinBasis:
    """Islands without any margin: every texel that a triangle of the hand touches, and no other."""
    rng = np.random.default_rng(0)
    inside = np.zeros((PX, PX), bool)  # column, row
    for share in rng.dirichlet(np.ones(3), 200):
        column, row = np.clip((np.einsum("k,fkd->fd", share, right.corner_uv) * PX).astype(int), 0, PX - 1).T
        inside[column, PX - 1 - row] = True
    index_map = np.flatnonzero(np.broadcast_to(inside, (3, PX, PX)))
    n = len(index_map)
    return SkinBasis(
        name="tight",
        size=PX,
        mean=np.repeat([180.0, 140.0, 110.0], n // 3).astype(np.float32),
        basis=rng.normal(size=(n, 5)).astype(np.float32),
        index_map=index_map,
        axes=("",) * 5,
        anchors=np.zeros((0, 5)),
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, tight_skin: SkinBasis) -> Path:
    path = tmp_path_factory.mktemp("html")
    write_html(path, skin=tight_skin)
    write_mano(path)
    return path


@pytest.fixture(scope="module")
def html(folder: Path, right: HandModel) -> HtmlSkin:
    return load_html_skin(folder, right, right_faces=right.faces, texture_px=PX)


def test_textures_of_the_open_skin_come_back_from_the_official_layout(
    tmp_path: Path, right: HandModel
) -> None:
    skin = load_open_skin()
    few = replace(skin, basis=skin.basis[:, :2], axes=skin.axes[:2], anchors=skin.anchors[:, :2])
    write_html(tmp_path, skin=few, variants=["model_wosr"])
    read = load_html_skin(tmp_path, right, variant="model_wosr")
    assert read.basis.name == "html model_wosr"
    for anchor in few.anchors[:2]:
        texture, expected = decode_skin(read.basis, anchor), decode_skin(few, anchor)
        painted = expected.any(axis=-1)
        np.testing.assert_array_equal(texture[painted], expected[painted])
    np.testing.assert_allclose(read.corner_uv, right.corner_uv, atol=1e-12)


def test_texels_outside_the_islands_copy_the_nearest_one_inside(
    html: HtmlSkin, tight_skin: SkinBasis
) -> None:
    alpha = np.ones(5)
    plain, filled = decode_skin(tight_skin, alpha), decode_skin(html.basis, alpha)
    painted = plain.all(axis=-1)
    assert 0.2 < painted.mean() < 0.9
    np.testing.assert_array_equal(filled[painted], plain[painted])
    places = np.argwhere(painted)
    for row, column in np.argwhere(~painted)[::37]:
        squared = ((places - (row, column)) ** 2).sum(axis=1)
        nearest = places[squared == squared.min()]
        assert filled[row, column].tolist() in plain[nearest[:, 0], nearest[:, 1]].tolist()


def test_bilinear_filtering_finds_no_dark_seam(html: HtmlSkin, tight_skin: SkinBasis) -> None:
    uv = np.einsum("sk,fkd->sfd", np.random.default_rng(1).dirichlet(np.full(3, 0.3), 40), html.corner_uv)
    darkest = [
        texture_lookup(decode_skin(basis, np.zeros(5)).astype(float), uv)[..., 0].min()
        for basis in (tight_skin, html.basis)
    ]
    assert darkest[0] < 100.0, "the unfilled texture has dark seams"
    assert darkest[1] == pytest.approx(180.0)


def test_the_open_skin_is_not_filled() -> None:
    assert load_open_skin().fill is None


def test_coefficients_are_drawn_from_the_clipped_normal(html: HtmlSkin) -> None:
    rng = np.random.default_rng(0)
    draws = np.stack([sample_skin_coefficients(rng, html.basis) for _ in range(2000)])
    assert np.abs(draws).max() == 2.0
    assert np.abs(draws.mean(axis=0)).max() < 0.1
    assert draws.std(axis=0) == pytest.approx(np.full(5, 0.96), abs=0.04)


def _uv_of_vertices(model: HandModel, corner_uv: np.ndarray) -> list[set[tuple[float, ...]]]:
    found: list[set[tuple[float, ...]]] = [set() for _ in model.v_template]
    for vertex, uv in zip(model.faces.reshape(-1), np.round(corner_uv.reshape(-1, 2), 9)):
        found[vertex].add(tuple(uv))
    return found


@pytest.mark.parametrize("kind", ["file", "mirrored"])
def test_left_hands_show_at_each_vertex_what_the_right_one_shows(
    kind: str, folder: Path, right: HandModel, html: HtmlSkin
) -> None:
    left = load_mano(folder, "left") if kind == "file" else mirror_hand(right)
    assert (left.faces != right.faces).any()
    read = load_html_skin(folder, left, right_faces=right.faces, texture_px=PX)
    assert _uv_of_vertices(left, read.corner_uv) == _uv_of_vertices(right, html.corner_uv)
    middle = {frozenset(face): uv for face, uv in zip(right.faces.tolist(), html.corner_uv.mean(axis=1))}
    for face, uv in zip(left.faces.tolist(), read.corner_uv.mean(axis=1)):
        np.testing.assert_allclose(uv, middle[frozenset(face)], atol=1e-12)


def test_uv_of_a_mirrored_model_is_that_of_mirror_hand(folder: Path, right: HandModel) -> None:
    left = mirror_hand(right)
    read = load_html_skin(folder, left, right_faces=right.faces, texture_px=PX)
    np.testing.assert_allclose(read.corner_uv, left.corner_uv, atol=1e-12)


def test_copies_with_a_file_per_hand_and_the_inner_folder_are_found(
    tmp_path: Path, right: HandModel, tight_skin: SkinBasis, html: HtmlSkin
) -> None:
    write_html(tmp_path, skin=tight_skin, uv_name="uvs_right.pkl")
    read = load_html_skin(tmp_path / "TextureBasis", right, right_faces=right.faces, texture_px=PX)
    np.testing.assert_array_equal(read.corner_uv, html.corner_uv)
    np.testing.assert_array_equal(read.basis.mean, html.basis.mean)


MODEL, UVS = "TextureBasis/model_sr/model.pkl", "TextureBasis/uvs.pkl"


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        (MODEL, lambda d: d.pop("index_map"), "the key index_map is missing; .*found basis, mean"),
        (MODEL, lambda d: d.update(mean=d["mean"][:-1]), "mean .* and index_map .* disagree"),
        (MODEL, lambda d: d.update(basis=d["basis"][0]), "disagree"),
        (MODEL, lambda d: d["index_map"].__setitem__(-1, 3 * PX**2), "index_map goes from .* to 12288"),
        (MODEL, lambda d: d["index_map"].__setitem__(0, -1), "index_map goes from -1"),
        (MODEL, lambda d: d["index_map"].__setitem__(0, d["index_map"][1]), "index_map repeats"),
        (MODEL, lambda d: d.update(index_map=d["index_map"] + 0.5), "index_map is of type float64"),
        (MODEL, lambda d: d["mean"].__setitem__(3, np.nan), "NaN"),
        (MODEL, lambda d: d.update(mean=d["mean"] / 255.0), "mean goes up to 0.7"),
        (MODEL, lambda d: d.update(mean="mean"), "mean is of type str"),
        (UVS, lambda d: d.pop("verts_uvs"), "the key verts_uvs is missing"),
        (UVS, lambda d: d.update(faces_uvs=d["faces_uvs"][:-1]), r"faces_uvs has shape \(3195, 3\)"),
        (UVS, lambda d: d["faces_uvs"].__setitem__((0, 0), 10**6), "faces_uvs names the points .* 1000000"),
        (UVS, lambda d: d.update(verts_uvs=d["verts_uvs"][:, :1]), "verts_uvs has shape"),
        (UVS, lambda d: d.clear(), "the key faces_uvs is missing"),
    ],
)
def test_broken_files_end_as_one_line_that_names_file_and_key(
    file: str,
    change: Callable[[dict[str, Any]], object],
    message: str,
    folder: Path,
    tmp_path: Path,
    right: HandModel,
) -> None:
    shutil.copytree(folder / "TextureBasis", tmp_path / "TextureBasis")
    path = tmp_path / file
    data = pickle.loads(path.read_bytes())
    change(data)
    path.write_bytes(pickle.dumps(data, 2))
    with pytest.raises(InputError, match=message) as error:
        load_html_skin(tmp_path, right, right_faces=right.faces, texture_px=PX)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


def test_missing_files_and_other_hands_are_named(folder: Path, tmp_path: Path, right: HandModel) -> None:
    with pytest.raises(InputError, match=r"holds no TextureBasis/model_sr/model\.pkl"):
        load_html_skin(tmp_path, right, right_faces=right.faces)
    other = replace(right, faces=np.roll(right.faces, 1, axis=0) % 100)
    with pytest.raises(InputError, match="for other faces than those of the right hand 'openhand'"):
        load_html_skin(folder, other, right_faces=right.faces, texture_px=PX)
    with pytest.raises(ValueError, match="needs right_faces"):
        load_html_skin(folder, mirror_hand(right), texture_px=PX)
    with pytest.raises(InputError, match="index_map goes from"):
        load_html_skin(folder, right, right_faces=right.faces, texture_px=PX // 2)
