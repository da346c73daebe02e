"""A component's streams, its metrics on any number of processes, and that nothing is left running."""

import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from multiprocessing import active_children
from pathlib import Path

import pytest
import torch
from accelerate import Accelerator

from model.data.batch import Batch
from model.data.stream import ShardStream
from model.recipes.components.component_data import component_data
from model.training.task import Losses, Measurements
from model.training.trainer import NonFiniteLossError
from shards.errors import ShardError
from tests.model.data.balls import VARIED, data_config, write_balls
from tests.model.recipes.filled import RECIPE, VALIDATION, Filled, run

ROOT = Path(__file__).resolve().parents[3]
FILLED = Path(__file__).with_name("filled.py")


def test_one_pass_reads_each_training_motion_once_and_never_mirrored(tmp_path):
    always = replace(VARIED, flip_probability=1.0)
    varied = data_config(write_balls(tmp_path / "balls"), augmentation=always, samples_per_motion=5)
    data = component_data(varied, VALIDATION, RECIPE, Accelerator(cpu=True), surface=False)
    once = data.each_motion_once(8)
    (batch,) = once
    assert len(batch.ids) == len({name.split(":")[0] for name in batch.ids}) == 3
    assert batch.is_right.all()
    (mirrored,) = ShardStream(replace(once.config, augmentation=always))
    assert not mirrored.is_right.any()


@pytest.mark.slow
def test_two_processes_share_the_validation_and_give_the_metrics_of_one(tmp_path):
    dataset = write_balls(tmp_path / "balls", splits=[["train", "train", "val", "val"]])
    alone = Filled()
    metrics = run(alone, dataset, tmp_path / "one")
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--nproc-per-node=2",
        str(FILLED),
    ]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*command, str(dataset), str(tmp_path / "two")],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    shared = json.loads((tmp_path / "two" / "filled" / "metrics.json").read_text())
    assert shared == pytest.approx(metrics, rel=1e-6)  # weights differ in their last bits
    parts = [json.loads((tmp_path / "two" / f"measured-{rank}.json").read_text()) for rank in (0, 1)]
    assert [len(part) for part in parts] == [4, 2]  # batches 0 and 2, and batch 1
    assert sorted(parts[0] + parts[1]) == sorted(alone.measured)


class _NothingToMeasure(Filled):
    def measure(self, batches: Iterable[Batch]) -> Measurements:
        return Measurements(numbers={"known": [0.25 for _ in batches], "occluded": []}, images={})


def test_metrics_are_strict_json(tmp_path):
    """A metric that nothing was there for is null, and not a number again when it is read."""
    dataset = write_balls(tmp_path / "balls")
    for _ in range(2):  # trained, and found trained
        metrics = run(_NothingToMeasure(), dataset, tmp_path / "run")
        assert metrics["known"] == 0.25
        assert math.isnan(metrics["occluded"])

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    text = (tmp_path / "run" / "filled" / "metrics.json").read_text()
    assert json.loads(text, parse_constant=refuse) == {"known": 0.25, "occluded": None}


class _Diverges(Filled):
    def loss(self, batch: Batch, generators: Sequence[torch.Generator]) -> Losses:
        return Losses(total=self.module.bias.sum() * math.nan, parts={})


def test_loader_processes_end_with_a_run_that_diverges(tmp_path):
    dataset = write_balls(tmp_path / "balls")
    with pytest.raises(NonFiniteLossError) as caught:
        run(_Diverges(), dataset, tmp_path / "run", workers=1)
    view = r"\(motion-00000\d-camera-0\d frame \d\)"
    assert re.search(rf"for samples motion-00000\d:0:0 {view}, motion-00000\d:0:1 {view};", str(caught.value))
    assert active_children() == []
    assert caught.value.__traceback__ is not None  # which keeps alive what its frames hold


def test_loader_processes_end_with_data_that_cannot_be_read(tmp_path):
    dataset = write_balls(tmp_path / "balls")
    for file in dataset.glob("shards/*/frames.parquet"):
        content = bytearray(file.read_bytes())
        content[100 : len(content) // 2] = bytes(len(content) // 2 - 100)
        file.write_bytes(content)
    with pytest.raises(ShardError) as caught:
        run(Filled(), dataset, tmp_path / "run", workers=1)
    assert active_children() == []
    assert caught.value.__traceback__ is not None
