"""Training one component of a configuration to the end, and its metrics."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from accelerate import Accelerator
from accelerate.utils import gather_object

from model.data.config import DataConfig
from model.errors import ModelError
from model.recipes.components.component import Component
from model.recipes.components.component_data import ComponentData, component_data
from model.recipes.components.component_identity import as_yaml
from model.recipes.components.recipe import ValidationConfig
from model.training.task import Evaluation, Task, merged
from model.training.trainer import TrainingEvent, train

__all__ = ["SharedSections", "train_component"]


@runtime_checkable
class SharedSections(Protocol):
    """What all components of a configuration share: the configuration of either stage."""

    @property
    def data(self) -> DataConfig: ...

    @property
    def validation(self) -> ValidationConfig: ...


def train_component(
    component: Component,
    config: SharedSections,
    run: Path,
    *,
    accelerator: Accelerator,
    report: Callable[[TrainingEvent], None],
) -> dict[str, float]:
    """Train `component` of `config` from where it was stopped, and give its metrics on held-out views.

    ModelError when it has weights already, or when a component that it stands on is missing, of another
    configuration or of other data; ShardError.
    """
    recipe = component.recipe
    if recipe is None:
        raise ModelError(
            component.name,
            "has weights already, there is nothing to train",
            expected="a component with a recipe",
            action="Train another one, or give a configuration with a recipe for it.",
        )
    surface = component.reads_surfaces
    data = component_data(config.data, config.validation, recipe, accelerator, surface=surface)
    for earlier in component.stands_on:
        earlier.require_same_data(run, data)
    torch.manual_seed(recipe.trainer.seed)  # of the initial weights
    task = component.task(run, data, accelerator.device)
    measured: list[Evaluation] = []  # the last one

    def validate() -> Evaluation:
        measured[:] = [_validation(task, data, accelerator)]
        return measured[0]

    train(
        task,
        data.training,
        recipe.trainer,
        recipe.optimizer,
        folder=run / component.name,
        config_yaml=as_yaml(config),
        config_sha256=component.sha256(),
        validate=validate,
        report=report,
        accelerator=accelerator,
    )
    metrics_file = run / component.name / "metrics.json"
    if not measured and not metrics_file.exists():  # stopped between the last checkpoint and the metrics
        component.load_trained(run, task.module.eval())
        validate()
    if accelerator.is_main_process:
        if measured:
            _write_metrics(metrics_file, measured[0].metrics)
        component.exports(run)
    accelerator.wait_for_everyone()
    return _read_metrics(metrics_file)


def _validation(task: Task, data: ComponentData, accelerator: Accelerator) -> Evaluation:
    """Each rank measures some of the batches; the same metrics on every rank, and on any number of ranks."""
    rank, ranks = accelerator.process_index, accelerator.num_processes
    share = task.measure(data.validation(accelerator.device, rank, ranks))
    everything = merged(gather_object([replace(share, images={})]))
    return replace(everything, images=share.images).evaluation()  # images: those of the first rank are logged


def _write_metrics(path: Path, metrics: dict[str, float]) -> None:
    """JSON has no NaN and no infinity: null where nothing was there to measure."""
    held = {name: value if math.isfinite(value) else None for name, value in metrics.items()}
    path.write_text(json.dumps(held, indent=2, allow_nan=False), encoding="utf-8")


def _read_metrics(path: Path) -> dict[str, float]:
    held = json.loads(path.read_text(encoding="utf-8"))
    return {name: math.nan if value is None else value for name, value in held.items()}
