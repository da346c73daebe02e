"""`forehoi train` on a small dataset: all components, again without work, and what a user can get wrong."""

import json
import re
from dataclasses import replace
from pathlib import Path

import click
import pyarrow.parquet as pq
import pytest
import yaml
from click.testing import CliRunner

from model.cli.main import main
from model.cli.weights import weights
from model.recipes.config import read_settings
from shards.reader import open_dataset
from shards.splits import Split, SplitRule
from shards.storage.parquet import file_record
from shards.storage.records import write_record
from tests.model.data.balls import uid_of_split, write_balls
from tests.model.small_run import ROOT, fails, forehoi, small_settings, write_config


@pytest.mark.parametrize("name", sorted(main.commands))
def test_every_command_is_in_the_readme_and_has_help_with_an_example(name):
    text = CliRunner().invoke(main, [name, "--help"]).output
    assert "Example:" in text
    assert re.search(rf"^ +forehoi {name} ?", text, re.MULTILINE)
    assert f"forehoi {name}" in (ROOT / "README.md").read_text()
    assert_options_have_help(main.commands[name])


@pytest.mark.parametrize("name", sorted(weights.commands))
def test_every_command_on_weights_has_help_with_an_example(name):
    text = CliRunner().invoke(main, ["weights", name, "--help"]).output
    assert re.search(rf"Example:\n +forehoi weights {name} ", text)
    assert_options_have_help(weights.commands[name])


def assert_options_have_help(command: click.Command) -> None:
    assert all(parameter.help for parameter in command.params if isinstance(parameter, click.Option))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    return write_balls(tmp_path_factory.mktemp("balls"))


@pytest.fixture(scope="module")
def finished(dataset, tmp_path_factory) -> tuple[Path, Path]:
    """A configuration and the run of all its components. Do not change it."""
    root = tmp_path_factory.mktemp("finished")
    config = write_config(root / "small.yaml", small_settings(dataset))
    status, output = forehoi("train", config, "--out", root / "run")
    assert status == 0, output
    for component, metric in (
        ("vae", "voxel_iou"),
        ("hand_encoder", "hand_mask_iou"),
        ("stage_one", "mask_iou"),
    ):
        assert metric in output
        assert metric in json.loads((root / "run" / component / "metrics.json").read_text())
    return config, root / "run"


def test_all_components_train_and_a_second_run_changes_nothing(finished):
    config, out = finished
    for component in ("vae", "hand_encoder", "stage_one"):
        assert (out / component / "checkpoints" / "step-00000002" / "state.json").is_file()
        assert list((out / component / "tensorboard").iterdir())
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors")}
    status, _ = forehoi("train", config, "--out", out)
    assert status == 0
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors")} == before


def test_stage_one_without_what_it_stands_on_says_what_to_train(dataset, tmp_path):
    config = write_config(tmp_path / "small.yaml", small_settings(dataset))
    text = fails("train", "stage_one", "--config", config, "--out", tmp_path / "run")
    assert "holds no checkpoint; expected the trained vae. Train it first: forehoi train vae." in text


def test_the_folder_of_a_run_is_named_after_the_file_as_the_help_says(dataset, tmp_path, monkeypatch):
    text = CliRunner().invoke(main, ["train", "--help"]).output
    assert "runs/NAME for a configuration NAME.yaml" in " ".join(text.split())
    settings = small_settings(dataset)
    assert settings["name"] == "tiny"
    config = write_config(tmp_path / "mine.yaml", settings)
    monkeypatch.chdir(tmp_path)
    assert "runs/mine/vae: holds no checkpoint" in fails("train", "stage_one", "--config", config)


def test_a_checkpoint_of_another_configuration(finished, tmp_path):
    """Of the component itself, and of one that it stands on."""
    config, out = finished
    text = config.read_text()
    other = tmp_path / "other.yaml"
    other.write_text(text.replace("beta: 1.0", "beta: 2.0"))
    assert "stage_one/checkpoints/step-00000002: was trained with another configuration" in fails(
        "train", other, "--out", out
    )
    other.write_text(text.replace("middle_blocks: 1", "middle_blocks: 2"))
    line = fails("train", "stage_one", "--config", other, "--out", out)
    assert "vae/checkpoints/step-00000002" in line


def test_a_component_that_is_not_there_or_of_the_other_stage(finished, tmp_path):
    config, out = finished
    text = fails("train", "slat_flow", "--config", config, "--out", out)
    assert "has no slat_flow to train; expected a component: vae, hand_encoder, stage_one." in text
    without = yaml.safe_load(config.read_text()) | {"hand_encoder": None}
    without["encoders"]["hand"] = {"packaged_grid": 8}
    path = write_config(tmp_path / "without.yaml", without)
    assert "has no hand_encoder to train; expected a component: vae, stage_one." in fails(
        "train", "hand_encoder", "--config", path, "--out", out
    )


def test_a_run_without_adapters_has_nothing_to_merge(finished, tmp_path):
    _, out = finished
    assert "was trained without adapters" in fails(
        "weights", "merge", out, "--out", tmp_path / "m.safetensors"
    )


def test_missing_unknown_and_contradicting_keys(dataset, tmp_path):
    path = write_config(tmp_path / "small.yaml", small_settings(dataset))
    text = path.read_text()
    for old, new, expected in (
        (str(dataset), str(tmp_path / "nothing"), "nothing"),
        ("drop_condition", "drop_conditions", "(did you mean 'drop_condition'?)"),
        ("  beta: 1.0\n", "", "missing key 'stage_one.beta'"),
        ("beta: 1.0", "beta: much", "'stage_one.beta': expected a number, found 'much'"),
        ("latent_resolution: 4", "latent_resolution: 8", "expected the same shape"),
        ("grid: 8\n      heads", "grid: 4\n      heads", "mask tokens lie on the image tokens"),
        ("  seed: 0\n  split", "  batch_size: 8\n  seed: 0\n  split", "unknown key 'data.batch_size'"),
        ("name: tiny", "name: [tiny", "not valid YAML"),
    ):
        assert text.count(old) == 1, old
        path.write_text(text.replace(old, new))
        assert expected in fails("train", path, "--out", tmp_path / "run")
    assert "no such configuration" in fails("train", tmp_path / "none.yaml")
    assert not (tmp_path / "run").exists()


def test_a_hand_encoder_that_is_not_used_or_not_trained(dataset, tmp_path):
    settings = small_settings(dataset)
    unused = settings | {"encoders": settings["encoders"] | {"hand": WILOR}}
    text = fails("train", write_config(tmp_path / "unused.yaml", unused), "--out", tmp_path / "run")
    assert "expected hand_encoder to be null" in text
    untrained = write_config(tmp_path / "untrained.yaml", settings | {"hand_encoder": None})
    assert "expected how to train it" in fails("train", untrained, "--out", tmp_path / "run")


WILOR = {"checkpoint": "wilor_final.ckpt", "image_size": 224, "grid": 14}


def train_on(tmp_path: Path, *datasets: Path) -> str:
    """The one line when training starts on these datasets."""
    settings = small_settings(datasets[0])
    settings["data"]["datasets"] = [str(dataset) for dataset in datasets]
    return fails("train", write_config(tmp_path / "small.yaml", settings), "--out", tmp_path / "run")


def test_no_finished_shard(tmp_path):
    root = write_balls(tmp_path / "empty", splits=())
    text = train_on(tmp_path, root)
    assert str(root) in text
    assert "no finished shard" in text


def test_an_object_in_two_splits(dataset, tmp_path):
    uid = uid_of_split("train", 0)
    motions: list[Split] = ["val"] * (int(uid.removeprefix("ball-")) + 1)
    rule = SplitRule(val_fraction=1.0, test_fraction=0.0)
    other = write_balls(tmp_path / "other", splits=[motions], cameras=1, rule=rule)
    text = train_on(tmp_path, dataset, other)
    assert f"'{uid}'" in text
    assert "one split" in text


def test_a_missing_column(tmp_path):
    root = write_balls(tmp_path / "balls", splits=[["train"]])
    folder = root / "shards" / "shard-00000"
    pq.write_table(
        pq.read_table(folder / "frames.parquet").drop_columns(["masks"]), folder / "frames.parquet"
    )
    record = open_dataset(root).shards[0].record
    files = record.files | {"frames.parquet": file_record(folder / "frames.parquet")}
    write_record(folder / "shard.json", replace(record, files=files))
    text = train_on(tmp_path, root)
    assert "frames.parquet" in text
    assert "'masks'" in text


def test_the_paper_without_its_weights_says_how_to_make_them(dataset, tmp_path, monkeypatch):
    settings = read_settings("paper").data
    settings["data"] |= {"datasets": [str(dataset)], "workers": 0, "held_out_cameras": 0.4}
    settings["stage_one"]["recipe"] |= {"views": [1, 2]}
    settings["validation"] |= {"views": 1, "split": "train"}
    monkeypatch.chdir(tmp_path)
    text = fails("train", write_config(tmp_path / "paper.yaml", settings))
    assert "weights/trellis.safetensors: there is no such file" in text
    assert "forehoi weights import" in text


def test_a_split_without_motions(dataset, tmp_path):
    settings = small_settings(dataset)
    settings["data"]["split"] = "test"
    settings["validation"]["split"] = "test"
    text = fails("train", write_config(tmp_path / "small.yaml", settings), "--out", tmp_path / "run")
    assert "3 train, 1 val, 0 test" in text
