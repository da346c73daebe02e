"""A run resumes wherever its data lie and is used where they are not; other data are refused."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from model.recipes.config import load_config
from tests.model.data.balls import write_balls
from tests.model.small_run import fails, forehoi
from tests.model.stages import stage_one


@pytest.fixture
def elsewhere(stage_one_run, tmp_path) -> tuple[Path, Path]:
    """A copy of the run, and its configuration with data in another place, where there are none yet."""
    run = Path(shutil.copytree(stage_one_run.folder, tmp_path / "run"))
    text = stage_one_run.config.read_text().replace(str(stage_one_run.dataset), str(tmp_path / "there"))
    config = tmp_path / "small.yaml"
    config.write_text(text)
    return run, config


def test_a_run_goes_on_with_data_that_were_moved(stage_one_run, elsewhere, tmp_path):
    run, config = elsewhere
    shutil.copytree(stage_one_run.dataset, tmp_path / "there")
    shutil.rmtree(run / "stage_one" / "checkpoints" / "step-00000002")  # as if stopped after the first step
    status, output = forehoi("train", config, "--out", run)
    assert status == 0, output
    state = json.loads((run / "stage_one" / "checkpoints" / "step-00000002" / "state.json").read_text())
    assert str(tmp_path / "there") in state["config_yaml"]
    before = json.loads((stage_one_run.folder / "stage_one" / "metrics.json").read_text())
    assert json.loads((run / "stage_one" / "metrics.json").read_text()) == before


def test_a_run_that_was_stopped_before_its_first_checkpoint_ends_as_one_in_one_go(stage_one_run, tmp_path):
    """It left nothing but what it measured of the data."""
    run = Path(shutil.copytree(stage_one_run.folder, tmp_path / "run"))
    shutil.rmtree(run / "stage_one" / "checkpoints")
    status, output = forehoi("train", stage_one_run.config, "--out", run)
    assert status == 0, output
    newest = Path("stage_one") / "checkpoints" / "step-00000002" / "weights.safetensors"
    again, before = load_file(run / newest), load_file(stage_one_run.folder / newest)
    assert again.keys() == before.keys()
    assert all(torch.equal(again[name], before[name]) for name in before)


@pytest.mark.parametrize("component", ["vae", "stage_one"])
def test_other_data_are_refused(elsewhere, tmp_path, component):
    """Of the component itself, and of one that it stands on."""
    run, config = elsewhere
    write_balls(tmp_path / "there")
    shutil.rmtree(run / "stage_one")
    line = fails("train", component, "--config", config, "--out", run)
    assert "vae/checkpoints/step-00000002: was trained on other data" in line


def test_a_run_is_used_where_its_data_are_not(elsewhere, tmp_path):
    run, config = elsewhere
    task = stage_one(load_config(config)).flow.load(run, torch.device("cpu"))
    found = task.predict(torch.rand(1, 2, 3, 64, 64), torch.Generator().manual_seed(0))
    assert found.occupancy.shape == (1, 64, 64, 64)
    assert not (tmp_path / "there").exists()
