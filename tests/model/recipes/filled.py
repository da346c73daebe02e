"""The smallest component to train on shards: one number learns how much of the cube is filled.

Also a program, for tests over several processes: `python filled.py DATASET FOLDER`.
"""

import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from accelerate import Accelerator
from torch import nn

from model.data.batch import Batch
from model.data.config import DataConfig
from model.recipes.components.component import Component
from model.recipes.components.component_data import ComponentData
from model.recipes.components.recipe import ImageRecipe, ValidationConfig
from model.recipes.train_component import train_component
from model.training.task import Losses, Measurements, Task
from tests.model.data.balls import data_config
from tests.model.training.toy import OPTIMIZER, settings

RECIPE = ImageRecipe(trainer=settings(2), optimizer=OPTIMIZER, batch_size=2, views=(1, 1), image_size=16)
VALIDATION = ValidationConfig(split="val", views=1, batch_size=2, samples_per_motion=3, batches=3)


class Filled:
    def __init__(self) -> None:
        self.module = nn.Linear(1, 1)
        nn.init.zeros_(self.module.bias)
        self.measured: list[str] = []

    def loss(self, batch: Batch, generators: Sequence[torch.Generator]) -> Losses:
        return Losses(total=(self.module.bias - _share(batch)).square().mean(), parts={})

    def measure(self, batches: Iterable[Batch]) -> Measurements:
        errors: list[float] = []
        self.measured.clear()
        for batch in batches:
            self.measured += batch.ids
            errors += (self.module.bias - _share(batch)).abs().tolist()
        return Measurements(numbers={"error": errors}, images={})


@dataclass(frozen=True, kw_only=True)
class FilledComponent(Component):
    name: ClassVar[str] = "filled"
    made: Task

    @property
    def recipe(self) -> ImageRecipe:
        return RECIPE

    def sha256(self) -> str:
        return "sha"

    def task(self, run: Path, data: ComponentData, device: torch.device) -> Task:
        return self.made


@dataclass(frozen=True, kw_only=True)
class FilledConfig:
    data: DataConfig
    validation: ValidationConfig


def run(task: Task, dataset: Path, folder: Path, **data: object) -> dict[str, float]:
    return train_component(
        FilledComponent(made=task),
        FilledConfig(data=data_config(dataset, **data), validation=VALIDATION),
        folder,
        accelerator=Accelerator(cpu=True),
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
