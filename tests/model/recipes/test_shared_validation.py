"""Two processes share the validation of every component, and give the metrics of one."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from shards.splits import Split
from tests.model.data.balls import write_balls
from tests.model.inference.small_networks import small_stage_two
from tests.model.small_run import ROOT, forehoi, small_settings, write_config

OBJECTS, BATCHES = 3, 5  # of one sample each: two of the objects are seen by both processes


def settings_of(stage: int, dataset: Path) -> dict[str, Any]:
    """Trainings that change no weight, so that the processes differ in nothing but what they measure."""
    settings = small_settings(dataset) if stage == 1 else small_stage_two(dataset)
    settings["data"]["held_out_cameras"] = 0.0
    settings["validation"] |= {
        "split": "val",
        "views": 2,
        "batch_size": 1,
        "samples_per_motion": 2,
        "batches": BATCHES,
    }
    for name in ("vae", "hand_encoder", "stage_one") if stage == 1 else ("slat_vae", "slat_flow"):
        recipe = settings[name]["recipe"]
        recipe["batch_size"] = 2
        recipe["optimizer"]["learning_rate"] = 0.0
        recipe["trainer"] |= {"steps": 1, "checkpoint_every": 1, "validate_every": 1, "precision": "float32"}
    return settings


@pytest.mark.slow
@pytest.mark.parametrize("stage", [1, 2])
def test_two_processes_give_the_metrics_of_one(stage, tmp_path):
    held_out: list[Split] = ["val"] * OBJECTS
    splits: list[Split] = ["train", "train", *held_out]
    dataset = write_balls(tmp_path / "balls", splits=[splits])
    config = write_config(tmp_path / "config.yaml", settings_of(stage, dataset))
    status, output = forehoi("train", config, "--out", tmp_path / "one")
    assert status == 0, output
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    done = subprocess.run(
        [*launch, "-m", "model", "train", str(config), "--out", str(tmp_path / "two")],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "ACCELERATE_USE_CPU": "true"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    for folder in sorted((tmp_path / "one").iterdir()):
        alone = json.loads((folder / "metrics.json").read_text())
        shared = json.loads((tmp_path / "two" / folder.name / "metrics.json").read_text())
        assert any(value is not None and math.isfinite(value) for value in alone.values())
        assert shared == pytest.approx(alone, rel=1e-6), folder.name
