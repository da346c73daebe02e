"""Every command is documented, and what a user gets wrong is one clear line and exit status 2."""

import re
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from datagen.cli.main import main

ROOT = Path(__file__).resolve().parents[3]
TINY = ROOT / "configs" / "datagen" / "tiny.yaml"


def commands(group: click.Group, prefix: str = "datagen") -> list[tuple[str, click.Command]]:
    found = []
    for name, command in group.commands.items():
        path = f"{prefix} {name}"
        found += commands(command, path) if isinstance(command, click.Group) else [(path, command)]
    return found


@pytest.mark.parametrize(("path", "command"), commands(main), ids=lambda value: str(value))
def test_every_command_is_in_the_readme_and_has_help_with_an_example(path, command):
    text = CliRunner().invoke(main, [*path.split()[1:], "--help"]).output
    assert "Example:" in text
    assert re.search(rf"^ +{path} ?", text, re.MULTILINE), f"the example of '{path}' does not call it"
    assert path in (ROOT / "README.md").read_text()
    for parameter in command.params:
        if isinstance(parameter, click.Option):
            assert parameter.help, f"{path} {parameter.opts[0]} has no help"


def run(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(main, list(arguments))
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.output


def test_unknown_key_says_did_you_mean(tmp_path):
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(TINY.read_text().replace("motions_per_shard:", "motion_per_shard:"))
    status, output = run("plan", "--config", str(wrong), "--out", str(tmp_path / "data"))
    assert status == 2
    assert "motion_per_shard" in output
    assert "did you mean" in output
    assert "motions_per_shard" in output
    assert len(output.strip().splitlines()) == 1
    assert not (tmp_path / "data").exists()


def test_shard_outside_the_plan(tmp_path):
    status, output = run("render", "--config", str(TINY), "--out", str(tmp_path), "--shard", "7")
    assert status == 2
    assert "shard 7 is outside the plan: expected 0..0" in output


def test_missing_config_names_it(tmp_path):
    status, output = run("plan", "--config", str(tmp_path / "none.yaml"))
    assert status == 2
    assert "none.yaml: no such configuration" in output


def test_another_configuration_in_the_same_folder_is_refused(tmp_path):
    assert run("plan", "--config", str(TINY), "--out", str(tmp_path / "data"))[0] == 0
    other = tmp_path / "other.yaml"
    other.write_text(re.sub(r"^seed: \d+", "seed: 12345", TINY.read_text(), flags=re.MULTILINE))
    status, output = run("plan", "--config", str(other), "--out", str(tmp_path / "data"))
    assert status == 2
    assert "another configuration" in output


def test_inspect_and_verify_of_nothing(tmp_path):
    for arguments in (("inspect", "shard", "0", "--out", str(tmp_path)), ("verify", str(tmp_path))):
        status, output = run(*arguments)
        assert status == 2
        assert str(tmp_path) in output


@pytest.mark.parametrize("name", ["tiny", "small", "paper"])
def test_every_configuration_makes_its_plan(name, tmp_path):
    status, output = run("plan", "--config", name, "--out", str(tmp_path))
    assert status == 0, output
    assert (tmp_path / "plan.parquet").exists()
    assert (tmp_path / "dataset.json").exists()
