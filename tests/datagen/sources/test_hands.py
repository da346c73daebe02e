"""The hand that a configuration names: open or licensed, by path or by environment, never silently another."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datagen.hands.model import load_open_hand, mirror_hand
from datagen.hands.skin import decode_skin, load_open_skin
from datagen.input_error import InputError
from datagen.sources.hands import HandConfig, open_hand, resolved_hand
from tests.datagen.hands.official_files import write_html, write_mano

OPEN = HandConfig(model="open", mano_dir=None, skin="open", html_dir=None, left_probability=0.0)
AUTO = replace(OPEN, model="auto", skin="auto")


@pytest.fixture(autouse=True)
def no_places(monkeypatch):
    for variable in ("MANO_DIR", "HTML_DIR"):
        monkeypatch.delenv(variable, raising=False)


@pytest.fixture(scope="module")
def licensed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("licensed")
    write_mano(folder)
    write_html(folder)
    return folder


def test_auto_is_open_where_no_place_is_named():
    assert resolved_hand(AUTO) == OPEN


def test_a_named_place_without_the_files_is_an_error_not_the_open_hand(licensed, tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"holds no MANO_RIGHT\.pkl, though hand\.mano_dir"):
        resolved_hand(replace(AUTO, mano_dir=tmp_path))
    monkeypatch.setenv("MANO_DIR", str(tmp_path / "none"))
    with pytest.raises(InputError, match=r"none: holds no MANO_RIGHT\.pkl"):
        resolved_hand(AUTO)
    with pytest.raises(InputError, match=r"holds no TextureBasis/model_sr/model\.pkl"):
        resolved_hand(replace(AUTO, mano_dir=licensed, html_dir=tmp_path))


def test_places_may_be_the_file_itself_the_inner_folder_or_below_home(licensed, monkeypatch):
    monkeypatch.setenv("HOME", str(licensed.parent))
    for mano, html in (
        (licensed / "MANO_RIGHT.pkl", licensed / "TextureBasis"),
        (Path("~") / licensed.name, Path("~") / licensed.name),
    ):
        found = resolved_hand(replace(AUTO, mano_dir=mano, html_dir=html))
        assert (found.model, found.skin) == ("mano", "html")
        assert open_hand(found).skins.name == "html model_sr"


def test_auto_finds_the_licensed_files_by_path_and_by_environment(licensed, monkeypatch):
    by_path = resolved_hand(replace(AUTO, mano_dir=licensed, html_dir=licensed))
    monkeypatch.setenv("MANO_DIR", str(licensed))
    monkeypatch.setenv("HTML_DIR", str(licensed))
    by_environment = resolved_hand(AUTO)
    for found in (by_path, by_environment):
        assert (found.model, found.skin) == ("mano", "html")


def test_html_without_mano_is_never_chosen_and_never_accepted(licensed):
    assert resolved_hand(replace(AUTO, html_dir=licensed)).skin == "open"
    with pytest.raises(ValueError, match="laid out on MANO's triangles"):
        replace(OPEN, skin="html")
    with pytest.raises(InputError, match=r"hand\.skin: is html, but there is no MANO"):
        resolved_hand(replace(AUTO, skin="html", html_dir=licensed))


def test_mano_with_html_wears_the_html_texture(licensed):
    source = open_hand(replace(OPEN, model="mano", skin="html", mano_dir=licensed, html_dir=licensed))
    assert (source.right.name, source.skins.name) == ("mano", "html model_sr")
    texture = decode_skin(source.skins, np.zeros(source.skins.basis.shape[1]))
    assert texture.min() > 0  # filled beyond the islands: no dark seams
    assert source.right.corner_uv.shape == (len(source.right.faces), 3, 2)


def test_mano_without_html_wears_the_open_skin(licensed):
    source = open_hand(replace(OPEN, model="mano", mano_dir=licensed))
    assert (source.right.name, source.skins.name) == ("mano", "open")
    texture = decode_skin(source.skins, np.zeros(source.skins.basis.shape[1]))
    uv = source.right.corner_uv.mean(axis=1)
    rows, columns = (1.0 - uv[:, 1]) * texture.shape[0], uv[:, 0] * texture.shape[1]
    colors = texture[rows.astype(int), columns.astype(int)]
    assert (colors.sum(axis=-1) > 60).mean() > 0.999  # on the islands of the open layout


def test_the_left_hand_is_the_mirror_image(licensed):
    for config in (OPEN, replace(OPEN, model="mano", mano_dir=licensed)):
        source = open_hand(config)
        np.testing.assert_array_equal(source.model("left").v_template, mirror_hand(source.right).v_template)
        assert source.model("left").side == "left"
        assert source.model("right") is source.right


def test_the_open_hand_is_the_packaged_one():
    source = open_hand(OPEN)
    assert source.right is load_open_hand()
    assert source.skins is load_open_skin()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"model": "mano"},
            "hand.mano_dir: is null and MANO_DIR is not set; expected the folder that holds MANO",
        ),
        ({"model": "mano", "skin": "html"}, "hand.mano_dir"),
    ],
)
def test_what_is_missing_is_named_with_key_and_variable(change, message):
    with pytest.raises(InputError, match=message):
        open_hand(replace(OPEN, **change))


def test_html_missing_beside_mano_names_its_own_key(licensed, tmp_path):
    with pytest.raises(InputError, match=r"hand\.html_dir: is null and HTML_DIR is not set"):
        open_hand(replace(OPEN, model="mano", skin="html", mano_dir=licensed))
    with pytest.raises(InputError, match="TextureBasis"):
        open_hand(replace(OPEN, model="mano", skin="html", mano_dir=licensed, html_dir=tmp_path))


def test_mano_folder_without_the_file_names_it(tmp_path):
    with pytest.raises(InputError, match=r"MANO_RIGHT\.pkl"):
        open_hand(replace(OPEN, model="mano", mano_dir=tmp_path))


def test_probability_outside_the_unit_interval_is_refused():
    with pytest.raises(ValueError, match=r"left_probability is 1\.5: expected 0\.\.1"):
        replace(OPEN, left_probability=1.5)
