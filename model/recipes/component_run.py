"""Training one part of a configuration: its streams, the trainer, its metrics.

RUN/<part>    checkpoints, TensorBoard logs, metrics.json
"""

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import torch
from accelerate import Accelerator
from accelerate.utils import gather_object
from torch import nn

from model.data.batch import Batch
from model.data.config import StreamConfig
from model.data.stream import ShardStream, open_motions, validation_config
from model.errors import ModelError
from model.recipes.config import Recipe, ValidationConfig
from model.recipes.shard_source import StreamSource
from model.training.checkpoint import latest_checkpoint, load_average, read_state, require_data
from model.training.task import Evaluation, SharedValidation, Task
from model.training.trainer import TrainingEvent, train

__all__ = ["PartData", "load_part", "one_pass", "part_data", "require_same_data", "run_part"]


@dataclass(frozen=True, kw_only=True)
class PartData:
    """Streams of one part."""

    training: StreamSource
    held_out: StreamConfig
    batches: int

    def validation(self, device: torch.device, rank: int = 0, ranks: int = 1) -> Iterator[Batch]:
        """The same held-out views every time: every `ranks`-th batch from `rank` on. Each rank reads them all."""
        stream = ShardStream(self.held_out)
        try:
            for batch in islice(stream, rank, self.batches, ranks):
                yield batch.to(device, torch.float32)
        finally:
            stream.close()


def part_data(
    data: StreamConfig, validation: ValidationConfig, recipe: Recipe, accelerator: Accelerator
) -> PartData:
    """Streams with the sizes of `recipe`. Raises ModelError, ShardError."""
    stream = replace(data, batch_size=recipe.batch_size, views=recipe.views, image_size=recipe.image_size)
    held_out = validation_config(
        stream,
        split=validation.split,
        cameras="held_out" if validation.split == stream.split else "all",
        views=validation.views,
        batch_size=validation.batch_size,
    )
    return PartData(
        training=StreamSource(
            config=stream,
            index=open_motions(stream),
            rank=accelerator.process_index,
            ranks=accelerator.num_processes,
        ),
        held_out=replace(held_out, workers=0, samples_per_motion=validation.samples_per_motion),
        batches=validation.batches,
    )


def one_pass(data: StreamConfig, batch_size: int) -> StreamConfig:
    """The training motions once each, as they are: for what is measured on their objects."""
    once = validation_config(data, split=data.split, cameras=data.cameras, views=1, batch_size=batch_size)
    return replace(once, image_size=32, workers=0)


def run_part(
    task: Task,
    data: PartData,
    recipe: Recipe,
    folder: Path,
    *,
    config_yaml: str,
    config_sha256: str,
    accelerator: Accelerator,
    report: Callable[[TrainingEvent], None],
) -> dict[str, float]:
    """Train to the end, from where it was stopped, and give the metrics of the last validation."""
    last: list[Evaluation] = []

    def validate() -> Evaluation:
        last[:] = [_evaluation(task, data, accelerator)]
        return last[0]

    train(
        task,
        data.training,
        recipe.trainer,
        recipe.optimizer,
        folder=folder,
        config_yaml=config_yaml,
        config_sha256=config_sha256,
        validate=validate,
        report=report,
        accelerator=accelerator,
    )
    path = folder / "metrics.json"
    if not last and not path.exists():  # stopped between the last checkpoint and the metrics
        load_part(folder, task.module, config_sha256=config_sha256)
        validate()
    if last and accelerator.is_main_process:
        _write_metrics(path, last[0].metrics)
    accelerator.wait_for_everyone()
    return _read_metrics(path)


def require_same_data(folder: Path, data: PartData) -> None:
    """ModelError when the part in `folder` is trained, but on other data."""
    path = latest_checkpoint(folder / "checkpoints")
    if path is not None:
        require_data(path, read_state(path), data.training.data_sha256)


def _evaluation(task: Task, data: PartData, accelerator: Accelerator) -> Evaluation:
    """The same metrics on every rank, and on any number of ranks."""
    if not isinstance(task, SharedValidation):  # e.g. counts an object once however many batches show it
        return task.evaluate(data.validation(accelerator.device))
    rank, ranks = accelerator.process_index, accelerator.num_processes
    measured = task.measure(data.validation(accelerator.device, rank, ranks))
    numbers: dict[str, list[float]] = {}
    for of_rank in gather_object([measured.numbers]):
        for name, values in of_rank.items():
            numbers.setdefault(name, []).extend(values)
    return replace(measured, numbers=numbers).evaluation()  # images: those of the first rank are logged


def _write_metrics(path: Path, metrics: dict[str, float]) -> None:
    """JSON has no NaN and no infinity: null where nothing was there to measure."""
    held = {name: value if math.isfinite(value) else None for name, value in metrics.items()}
    path.write_text(json.dumps(held, indent=2, allow_nan=False), encoding="utf-8")


def _read_metrics(path: Path) -> dict[str, float]:
    held = json.loads(path.read_text(encoding="utf-8"))
    return {name: math.nan if value is None else value for name, value in held.items()}


def load_part(folder: Path, module: nn.Module, *, config_sha256: str) -> None:
    """Averaged weights of a trained part; needs no data. ModelError when it is missing or of another configuration."""
    path = latest_checkpoint(folder / "checkpoints")
    if path is None:
        raise ModelError(
            folder,
            "holds no checkpoint",
            expected=f"the trained {folder.name}",
            action=f"Train it first: forehoi train {folder.name}.",
        )
    state = load_average(path, module)
    if state.config_sha256 != config_sha256:
        raise ModelError(
            path,
            f"was trained with another configuration ({state.config_sha256[:12]})",
            expected=f"configuration {config_sha256[:12]}",
            action=f"Train the {folder.name} of this configuration into another folder (--out).",
        )
