"""Presets, files that extend them, and what `datagen config` prints."""

from dataclasses import replace

import pytest
from click.testing import CliRunner

from datagen.cli.main import main
from datagen.config import PRESETS, config_as_yaml, config_sha256, load_config, read_config
from shards.configuration.presets import preset_names
from shards.settings import SettingsError

NAMES = preset_names(PRESETS)
ABLATION = """\
extends: tiny
name: no_table
sampling:
  table: {probability: 0.0}
  lights: {hdris: !replace {studio: 1.0}}
"""


def run(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.output


def test_the_presets():
    assert NAMES == ["graspxl", "hands", "paper", "paper_graspxl", "small", "tiny"]


@pytest.mark.parametrize("name", NAMES)
def test_what_is_printed_reads_back_as_the_same_configuration(name, tmp_path):
    config = read_config(name)
    assert config.name == name
    status, text = run("config", name)
    assert status == 0
    assert "extends" not in text
    (tmp_path / "printed.yaml").write_text(text)
    assert read_config(tmp_path / "printed.yaml") == config


@pytest.mark.parametrize("name", NAMES)
def test_a_preset_does_not_differ_from_itself(name):
    assert run("config", name, "--diff", PRESETS / f"{name}.yaml") == (0, "")


def test_an_ablation_is_five_lines(tmp_path):
    path = tmp_path / "no_table.yaml"
    path.write_text(ABLATION)
    tiny, own = read_config("tiny"), read_config(path)
    sampling = replace(
        tiny.sampling,
        table=replace(tiny.sampling.table, probability=0.0),
        lights=replace(tiny.sampling.lights, hdris={"studio": 1.0}),
    )
    assert own == replace(tiny, name="no_table", sampling=sampling)
    assert config_sha256(own) != config_sha256(tiny)
    status, text = run("config", path, "--diff", "tiny")
    assert status == 0
    lines = text.splitlines()
    assert lines[:2] == ['name: "tiny" -> "no_table"', "sampling.lights.hdris.city: 1.0 -> absent"]
    assert lines[-1] == "sampling.table.probability: 0.6 -> 0.0"
    assert len(lines) == 2 + len(tiny.sampling.lights.hdris) - 1


def test_a_takedown_list_lies_beside_the_file_that_names_it(tmp_path):
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "lab.yaml").write_text("extends: tiny\nselection: {takedown: list.txt}\n")
    (tmp_path / "own.yaml").write_text("extends: lab/lab.yaml\nname: own\n")
    assert read_config(tmp_path / "own.yaml").selection.takedown == tmp_path / "lab" / "list.txt"


def test_what_is_used_says_what_auto_means_here(monkeypatch):
    monkeypatch.delenv("MANO_DIR", raising=False)
    monkeypatch.delenv("HTML_DIR", raising=False)
    assert (read_config("graspxl").hand.model, load_config("graspxl").hand.model) == ("auto", "open")
    assert "model: auto" in config_as_yaml(read_config("graspxl"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("extends: tiny\nplan: {motion: 3}\n", "unknown key 'plan.motion' (did you mean 'motions'?)"),
        ("extends: tiny\nplan: !replace {motions: 3}\n", "missing key 'plan.motions_per_shard'"),
        ("extends: tiny\nplan: !replace 3\n", "not valid YAML: expected a mapping node"),
        ("extends: tiny\nplan: !other {motions: 3}\n", "not valid YAML: could not determine a constructor"),
        ("extends: [tiny\n", "not valid YAML"),
        ("extends: own.yaml\n", "extends itself"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_file(tmp_path, text, message):
    path = tmp_path / "own.yaml"
    path.write_text(text)
    status, output = run("config", path)
    assert status == 2
    (line,) = output.splitlines()
    assert line.startswith(f"datagen: {path}")
    assert message in line


def test_an_unknown_preset_is_one_line():
    with pytest.raises(SettingsError, match=r"smal: no such preset \(did you mean 'small'\?\)"):
        read_config("smal")
    status, output = run("plan", "--config", "smal")
    assert status == 2
    assert len(output.splitlines()) == 1
