"""A name is a preset, anything with a slash or a suffix is a file."""

import pytest

from shards.configuration.presets import config_file, preset_names
from shards.settings import SettingsError


@pytest.fixture
def presets(tmp_path):
    folder = tmp_path / "presets"
    folder.mkdir()
    for name in ("tiny", "small"):
        (folder / f"{name}.yaml").write_text("")
    return folder


def test_a_name_is_a_preset_wherever_one_is(presets, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny").write_text("a file of that name is none")
    assert config_file("tiny", presets) == presets / "tiny.yaml"
    assert preset_names(presets) == ["small", "tiny"]


@pytest.mark.parametrize("name", ["own.yaml", "./own.yaml", "deeper/own", "../here/deeper/own"])
def test_a_path_is_a_file(presets, tmp_path, monkeypatch, name):
    here = tmp_path / "here"
    (here / "deeper").mkdir(parents=True)
    for path in (here / "own.yaml", here / "deeper" / "own"):
        path.write_text("")
    monkeypatch.chdir(here)
    assert config_file(name, presets).is_file()
    monkeypatch.chdir(tmp_path)
    assert config_file(name, presets, beside=here).is_file()


def test_unknown_names_list_what_there_is(presets, tmp_path):
    with pytest.raises(SettingsError) as unknown:
        config_file("tny", presets)
    assert str(unknown.value) == (
        "tny: no such preset (did you mean 'tiny'?); expected one of small, tiny, "
        "or a file, with its suffix or a slash: tny.yaml, ./tny"
    )
    with pytest.raises(SettingsError, match=r"none\.yaml: no such configuration; .* a preset: small, tiny"):
        config_file(tmp_path / "none.yaml", presets)
    with pytest.raises(SettingsError, match="nowhere, which holds none"):
        config_file("tiny", tmp_path / "nowhere")
