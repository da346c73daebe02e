"""`forehoi train` on a small dataset: all parts, again without work, and what a user can get wrong."""

import json
import re
from pathlib import Path

import click
import pytest
import yaml
from click.testing import CliRunner

from model.cli import main
from model.config import load_config
from tests.model.data.balls import write_balls

ROOT = Path(__file__).resolve().parents[2]
TINY = ROOT / "configs" / "model" / "tiny.yaml"


@pytest.mark.parametrize("name", sorted(main.commands))
def test_every_command_is_in_the_readme_and_has_help_with_an_example(name):
    text = CliRunner().invoke(main, [name, "--help"]).output
    assert "Example:" in text
    assert re.search(rf"^ +forehoi {name} ?", text, re.MULTILINE)
    assert f"forehoi {name}" in (ROOT / "README.md").read_text()
    for parameter in main.commands[name].params:
        if isinstance(parameter, click.Option):
            assert parameter.help


def small_config(folder: Path, dataset: Path) -> Path:
    """tiny.yaml with two steps of each part on small pictures."""
    config = yaml.safe_load(TINY.read_text())
    config["data"] |= {
        "datasets": [str(dataset)],
        "workers": 0,
        "samples_per_motion": 4,
        "held_out_cameras": 0.4,
    }
    config["validation"] |= {"views": 2, "batch_size": 2, "batches": 1}
    config["stage_one"]["sampler"]["steps"] = 2
    for part in ("vae", "hand_encoder", "stage_one"):
        recipe = config[part]["recipe"]
        recipe |= {"batch_size": 2, "views": [1, 2]}
        recipe["trainer"] |= {"steps": 2, "checkpoint_every": 1, "validate_every": 2, "log_every": 1}
    path = folder / "small.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("balls")
    write_balls(root)
    return root


def run(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(main, list(arguments))
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.output


def test_all_parts_train_and_a_second_run_changes_nothing(dataset, tmp_path):
    config, out = small_config(tmp_path, dataset), tmp_path / "run"
    status, output = run("train", str(config), "--out", str(out))
    assert status == 0, output
    for part, figure in (("vae", "voxel_iou"), ("hand_encoder", "hand_mask_iou"), ("stage_one", "mask_iou")):
        assert figure in output
        assert figure in json.loads((out / part / "figures.json").read_text())
        assert (out / part / "checkpoints" / "step-00000002" / "state.json").is_file()
        assert list((out / part / "tensorboard").iterdir())
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors")}
    status, _ = run("train", str(config), "--out", str(out))
    assert status == 0
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors")} == before


def test_stage_one_without_its_parts_says_what_to_train(dataset, tmp_path):
    config = small_config(tmp_path, dataset)
    status, output = run("train", "stage_one", "--config", str(config), "--out", str(tmp_path / "run"))
    assert status == 2
    assert "holds no checkpoint; expected the trained vae. Train it first: forehoi train vae." in output


def test_missing_data_unknown_key_and_contradiction_are_one_line(dataset, tmp_path):
    config = small_config(tmp_path, dataset)
    text = config.read_text()
    for old, new, expected in (
        (str(dataset), str(tmp_path / "nothing"), "nothing"),
        ("drop_condition", "drop_conditions", "did you mean"),
        ("latent_resolution: 8", "latent_resolution: 4", "expected the same shape"),
    ):
        config.write_text(text.replace(old, new))
        status, output = run("train", str(config), "--out", str(tmp_path / "run"))
        assert status == 2, output
        assert expected in output
        assert len(output.strip().splitlines()) == 1, output


def test_published_configurations_are_complete():
    for path in sorted((ROOT / "configs" / "model").glob("*.yaml")):
        assert load_config(path).name == path.stem
