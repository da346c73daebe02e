"""The smallest part to train on shards: one number learns how much of the cube is filled.

Also a program, for tests over several processes: `python filled.py DATASET FOLDER`.
"""

import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import torch
from accelerate import Accelerator
from torch import nn

from model.data.batch import Batch
from model.recipes.component_run import part_data, run_part
from model.recipes.config import Recipe, ValidationConfig
from model.training.task import Evaluation, Losses, Measurements, Task
from tests.model.data.balls import stream_config
from tests.model.training.toy import OPTIMIZER, settings

RECIPE = Recipe(trainer=settings(2), optimizer=OPTIMIZER, batch_size=2, views=(1, 1), image_size=16)
VALIDATION = ValidationConfig(split="val", views=1, batch_size=2, samples_per_motion=3, batches=3)


class Filled:
    def __init__(self) -> None:
        self.module = nn.Linear(1, 1)
        nn.init.zeros_(self.module.bias)
        self.measured: list[str] = []

    def loss(self, batch: Batch, generators: Sequence[torch.Generator]) -> Losses:
        return Losses(total=(self.module.bias - _share(batch)).square().mean(), parts={})

    def evaluate(self, batches: Iterable[Batch]) -> Evaluation:
        return self.measure(batches).evaluation()

    def measure(self, batches: Iterable[Batch]) -> Measurements:
        errors: list[float] = []
        self.measured.clear()
        for batch in batches:
            self.measured += batch.ids
            errors += (self.module.bias - _share(batch)).abs().tolist()
        return Measurements(numbers={"error": errors}, images={})


def run(task: Task, dataset: Path, folder: Path, **stream: object) -> dict[str, float]:
    accelerator = Accelerator(cpu=True)
    return run_part(
        task,
        part_data(stream_config(dataset, **stream), VALIDATION, RECIPE, accelerator),
        RECIPE,
        folder,
        config_yaml="yaml",
        config_sha256="sha",
        accelerator=accelerator,
        report=lambda _: None,
    )


def _share(batch: Batch) -> torch.Tensor:
    return batch.occupancy.float().mean((1, 2, 3))


def main(dataset: str, folder: str) -> None:
    task = Filled()
    run(task, Path(dataset), Path(folder))
    rank = Accelerator(cpu=True).process_index
    (Path(folder) / f"measured-{rank}.json").write_text(json.dumps(task.measured))


if __name__ == "__main__":
    main(*sys.argv[1:])
