"""Files that say what differs: merging, chains, circles, and which file is to blame."""

import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from shards.configuration.layers import MergedSettings, Replacement, merge_layers, read_layers
from shards.settings import SettingsError, settings_from_dict


@dataclass(frozen=True, kw_only=True)
class Small:
    grid: int
    size: int


@dataclass(frozen=True, kw_only=True)
class Large:
    source: str
    size: int


@dataclass(frozen=True, kw_only=True)
class Settings:
    name: str
    encoder: Small | Large
    steps: dict[str, int]
    views: tuple[int, ...]
    start: Small | None

    def __post_init__(self) -> None:
        if self.name == "bad":
            raise ValueError("name is bad")


BASE = {
    "name": "base",
    "encoder": {"grid": 16, "size": 128},
    "steps": {"one": 1, "two": 2},
    "views": [2, 4],
    "start": {"grid": 1, "size": 2},
}


def read(folder: Path, name: str = "own.json") -> MergedSettings:
    return read_layers(name, folder / "presets", lambda text, _where: json.loads(text), beside=folder)


@pytest.fixture
def write(tmp_path):
    (tmp_path / "presets").mkdir()
    (tmp_path / "presets" / "base.yaml").write_text(json.dumps(BASE))

    def write(name: str, /, **content: object) -> Path:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(content))
        return path

    return write


def test_mappings_merge_and_all_else_is_replaced():
    over = {"encoder": {"size": 64}, "steps": {"two": 3, "three": 4}, "views": [1], "start": None}
    assert merge_layers([("a", BASE), ("b", over)]).data == {
        "name": "base",
        "encoder": {"grid": 16, "size": 64},
        "steps": {"one": 1, "two": 3, "three": 4},
        "views": [1],
        "start": None,
    }


def test_a_replacement_takes_the_place_of_the_whole_mapping():
    over = {"encoder": Replacement(source="hub", size=64), "steps": Replacement()}
    data = merge_layers([("a", BASE), ("b", over), ("c", {"encoder": {"size": 32}})]).data
    assert data["encoder"] == {"source": "hub", "size": 32}
    assert data["steps"] == {}


def test_a_mapping_over_null_or_a_number_is_new():
    data = merge_layers([("a", {"x": None, "y": 1}), ("b", {"x": {"p": 1}, "y": {"q": 2}})]).data
    assert data == {"x": {"p": 1}, "y": {"q": 2}}


def test_merging_leaves_its_inputs_alone():
    before = json.dumps(BASE)
    merge_layers([("a", BASE), ("b", {"encoder": {"size": 64}}), ("c", {"steps": {"one": 5}})])
    assert json.dumps(BASE) == before


def test_chains_of_presets_and_of_files_beside_the_file(write, tmp_path):
    write("folder/middle.json", extends="base", steps={"one": 7}, views=[9])
    write("own.json", extends="folder/middle.json", steps={"two": 8})
    write("folder/last.json", extends="../own.json", name="last")
    merged = read(tmp_path, "folder/last.json")
    assert merged.data == BASE | {"name": "last", "steps": {"one": 7, "two": 8}, "views": [9]}
    assert merged.origins["name"] == str(tmp_path / "folder/last.json")
    assert merged.origins["steps.one"].endswith("middle.json")
    assert merged.origins["steps.two"].endswith("own.json")
    assert merged.origins["encoder.grid"].endswith("presets/base.yaml")
    assert merged.origins["views[0]"].endswith("middle.json")  # within what it belongs to


def test_circles_are_refused_in_one_line(write, tmp_path):
    write("own.json", extends="other.json")
    write("other.json", extends="./own.json")
    with pytest.raises(SettingsError) as caught:
        read(tmp_path)
    text = str(caught.value)
    assert "own.json -> " in text
    assert "other.json -> " in text
    assert "extends itself" in text
    assert "\n" not in text


@pytest.mark.parametrize(
    ("extends", "message"),
    [
        ("bas", "own.json: 'extends': bas: no such preset (did you mean 'base'?)"),
        ("none.json", "none.json: no such configuration"),
        (["base"], "own.json: 'extends': expected a preset's name or a file, found ['base']"),
    ],
)
def test_what_cannot_be_extended(write, tmp_path, extends, message):
    write("own.json", extends=extends)
    with pytest.raises(SettingsError) as caught:
        read(tmp_path)
    assert message in str(caught.value)


def test_a_file_that_is_no_mapping_is_refused(tmp_path):
    (tmp_path / "own.json").write_text("[1]")
    with pytest.raises(SettingsError, match=r"own\.json: expected a mapping of settings, found list"):
        read(tmp_path)
    (tmp_path / "own.json").write_bytes(b"\xff\xfe")
    with pytest.raises(SettingsError, match=r"own\.json: expected UTF-8 text"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("middle", "own", "file", "message"),
    [
        ({"nmae": "x"}, {}, "middle.json", "unknown key 'nmae' (did you mean 'name'?)"),
        ({}, {"nmae": "x"}, "own.json", "unknown key 'nmae' (did you mean 'name'?)"),
        (
            {"start": {"grd": 1}},
            {"start": {"grid": 1}},
            "middle.json",
            "unknown key 'start.grd' (did you mean 'grid'?)",
        ),
        ({"views": [1, "x"]}, {"name": "y"}, "middle.json", "'views[1]': expected a whole number, found 'x'"),
        (
            {"steps": {"one": 1.5}},
            {"steps": {"two": 1}},
            "middle.json",
            "'steps.one': expected a whole number",
        ),
        ({"start": Replacement(grid=1)}, {}, "middle.json", "missing key 'start.size'"),
        ({"name": "bad"}, {"views": [1]}, "own.json", "name is bad"),  # a contradiction of the whole
    ],
)
def test_errors_name_the_file_in_which_the_key_stands(middle, own, file, message):
    merged = merge_layers([("base.json", BASE), ("middle.json", middle), ("own.json", own)])
    with pytest.raises(SettingsError) as caught:
        settings_from_dict(Settings, merged.data, where=merged.origins)
    assert str(caught.value).startswith(f"{file}: ")
    assert message in str(caught.value)


def test_unknown_keys_of_two_files_are_told_one_file_at_a_time():
    merged = merge_layers([("base.json", BASE | {"old": 1}), ("own.json", {"new": 1})])
    with pytest.raises(SettingsError) as caught:
        settings_from_dict(Settings, merged.data, where=merged.origins)
    assert str(caught.value).startswith("base.json: unknown key 'old'")
    assert "'new'" not in str(caught.value)


def test_a_section_of_another_kind_says_how_to_replace():
    merged = merge_layers([("base.json", BASE), ("own.json", {"encoder": {"source": "hub", "size": 64}})])
    with pytest.raises(SettingsError) as caught:
        settings_from_dict(Settings, merged.data, where=merged.origins)
    text = str(caught.value)
    assert text.startswith("own.json: 'encoder' fits none of its forms: ")
    assert (
        "it is merged from own.json and base.json: `encoder: !replace` takes only what stands in own.json"
        in text
    )
    merged = merge_layers(
        [("base.json", BASE), ("own.json", {"encoder": Replacement(source="hub", size=64)})]
    )
    settings = settings_from_dict(Settings, merged.data, where=merged.origins)
    assert settings.encoder == Large(source="hub", size=64)
