"""The training loop: one process or many, exact resume on a CPU, SIGTERM saves, NaN stops with names.

Gradients are averaged over ranks by one reduction per step instead of a wrapper around the module,
so that a Task may call its networks as it likes. With equal global batches the result does not
depend on the number of ranks but for the order of floating-point sums.
"""

import math
import signal
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Protocol, runtime_checkable

import torch
from accelerate import Accelerator
from accelerate.utils import broadcast_object_list
from torch import nn
from torch.utils.tensorboard import SummaryWriter

from model.data.batch import Batch
from model.training.checkpoint import (
    TrainingState,
    delete_partial,
    latest_checkpoint,
    load_checkpoint,
    read_state,
    save_checkpoint,
)
from model.training.clock import Clock
from model.training.config import OptimizerConfig, TrainerConfig
from model.training.ema import MovingAverage
from model.training.precision import UsedPrecision, changes, this_machine, used_precision
from model.training.step_generators import sample_generators
from model.training.task import Evaluation, Losses, Task

__all__ = [
    "BatchSource",
    "NonFiniteLossError",
    "PlacedBatch",
    "RunStarted",
    "StepReport",
    "TrainingEvent",
    "TrainingStopped",
    "train",
]


class NonFiniteLossError(RuntimeError):
    """The loss became NaN or infinite; the message names motions, clips and frames, and where training can resume."""


class TrainingStopped(Exception):  # noqa: N818  (no error: the run was asked to stop and is saved)
    """SIGTERM arrived; the state is saved."""


@dataclass(frozen=True, kw_only=True)
class PlacedBatch:
    """A rank's share of a global batch, and where the stream stands after the whole of it."""

    batch: Batch
    places: Sequence[int]  # of its samples in the global batch
    epoch: int
    samples_consumed: int  # of the epoch, over all ranks


@runtime_checkable
class BatchSource(Protocol):
    """Batches from any point of the stream on, for ever."""

    @property
    def data_sha256(self) -> str:
        """Digest of what is read: a run resumes with the same data only."""

    def batches(self, epoch: int, samples_consumed: int) -> Generator[PlacedBatch, None, None]:
        """Batches of this rank from there on; epochs follow each other. Closing it ends what loads them."""


@dataclass(frozen=True, kw_only=True)
class RunStarted:
    """The first step is about to be made."""

    step: int  # finished steps: above 0 when a run is resumed
    steps: int
    notices: tuple[str, ...]  # what the user should read once


@dataclass(frozen=True, kw_only=True)
class StepReport:
    """One optimiser step, for progress bars."""

    step: int  # finished steps
    steps: int
    losses: dict[str, float]
    learning_rate: float
    gradient_norm: float
    samples_per_s: float
    waiting_share: float  # of the time since the last logged step spent waiting for data


TrainingEvent = RunStarted | StepReport


@dataclass(frozen=True, kw_only=True)
class _Run:
    """What stays the same during a run."""

    task: Task
    config: TrainerConfig
    optimizer_config: OptimizerConfig
    accelerator: Accelerator
    parameters: list[nn.Parameter]
    optimizer: torch.optim.Optimizer
    average: MovingAverage
    writer: SummaryWriter | None
    checkpoints: Path
    precision: UsedPrecision


def train(
    task: Task,
    source: BatchSource,
    config: TrainerConfig,
    optimizer_config: OptimizerConfig,
    *,
    folder: Path,
    config_yaml: str,
    config_sha256: str,
    validate: Callable[[], Evaluation] | None = None,
    report: Callable[[TrainingEvent], None] | None = None,
    accelerator: Accelerator | None = None,
) -> TrainingState:
    """Train to the end, from the newest checkpoint in `folder` if there is one.

    `validate` is called with the averaged weights in place; `report` before the first step and after each one, on the
    main process. Raises NonFiniteLossError, and
    TrainingStopped after SIGTERM; both leave a checkpoint to resume from. However it ends, the log is
    written and the loader processes are gone.
    """
    accelerator = accelerator or Accelerator()
    checkpoints = folder / "checkpoints"
    newest = _newest_checkpoint(checkpoints, accelerator)
    precision, notices = _agreed_precision(config, newest, accelerator)
    run = _prepare(task, config, optimizer_config, accelerator, folder, precision)
    state = TrainingState(
        step=0,
        epoch=0,
        samples_consumed=0,
        config_yaml=config_yaml,
        config_sha256=config_sha256,
        data_sha256=source.data_sha256,
        machine=this_machine(accelerator.device, precision),
    )
    try:
        if newest is not None:
            state = _restored(run, newest, state)
        if report is not None and accelerator.is_main_process:
            report(RunStarted(step=state.step, steps=config.steps, notices=notices))
        with _StopFlag() as stop, closing(source.batches(state.epoch, state.samples_consumed)) as batches:
            return _loop(run, batches, state, validate, report, stop)
    finally:
        if run.writer is not None:
            run.writer.close()


def _newest_checkpoint(folder: Path, accelerator: Accelerator) -> Path | None:
    """The same on every rank."""
    newest: list[Path | None] = [None]
    if accelerator.is_main_process:
        delete_partial(folder)
        newest = [latest_checkpoint(folder)]
    broadcast_object_list(newest)
    return newest[0]


def _agreed_precision(
    config: TrainerConfig, newest: Path | None, accelerator: Accelerator
) -> tuple[UsedPrecision, tuple[str, ...]]:
    """The precision that the main process finds, for all ranks; and what is to be said of it."""
    agreed: list[tuple[UsedPrecision, tuple[str, ...]] | None] = [None]
    if accelerator.is_main_process:
        recorded = read_state(newest).machine if newest is not None else None
        precision, line = used_precision(config.precision, accelerator.device, recorded)
        changed = changes(recorded, this_machine(accelerator.device, precision)) if recorded else None
        agreed = [(precision, (line,) if changed is None else (line, changed))]
    broadcast_object_list(agreed)
    assert agreed[0] is not None  # the main process has set it
    return agreed[0]


def _restored(run: _Run, newest: Path, begin: TrainingState) -> TrainingState:
    """The state of a checkpoint, with everything restored from it."""
    state = load_checkpoint(
        newest,
        run.task.module,
        run.average,
        run.optimizer,
        config_sha256=begin.config_sha256,
        data_sha256=begin.data_sha256,
    )
    # The bookkeeping, the places and the machine of now.
    return replace(state, config_yaml=begin.config_yaml, machine=begin.machine)


def _prepare(
    task: Task,
    config: TrainerConfig,
    optimizer_config: OptimizerConfig,
    accelerator: Accelerator,
    folder: Path,
    precision: UsedPrecision,
) -> _Run:
    task.module.to(accelerator.device)
    parameters = [parameter for parameter in task.module.parameters() if parameter.requires_grad]
    if accelerator.num_processes > 1:
        for parameter in parameters:
            torch.distributed.broadcast(parameter.detach(), 0)
    optimizer = torch.optim.AdamW(
        parameters,
        lr=optimizer_config.learning_rate,
        betas=optimizer_config.betas,
        weight_decay=optimizer_config.weight_decay,
        fused=True,
    )
    return _Run(
        task=task,
        config=config,
        optimizer_config=optimizer_config,
        accelerator=accelerator,
        parameters=parameters,
        optimizer=optimizer,
        average=MovingAverage(task.module, config.ema_decay),
        writer=SummaryWriter(folder / "tensorboard") if accelerator.is_main_process else None,
        checkpoints=folder / "checkpoints",
        precision=precision,
    )


def _loop(
    run: _Run,
    batches: Iterator[PlacedBatch],
    state: TrainingState,
    validate: Callable[[], Evaluation] | None,
    report: Callable[[TrainingEvent], None] | None,
    stop: "_StopFlag",
) -> TrainingState:
    config = run.config
    clock = Clock()
    saved_step = state.step
    while state.step < config.steps:
        run.task.module.train()
        losses, norm, rate, placed = _step(run, batches, state.step, clock)
        state = replace(
            state, step=state.step + 1, epoch=placed.epoch, samples_consumed=placed.samples_consumed
        )
        done = state.step == config.steps
        made = _step_report(run, state.step, losses, norm, rate, clock)
        if state.step % config.log_every == 0 or done:
            _log(run, made)
            clock.restart()
        if report is not None and run.accelerator.is_main_process:
            report(made)
        if validate is not None and (state.step % config.validate_every == 0 or done):
            _validate(run, state.step, validate)
            clock.pause()
        asked_to_stop = _any(run.accelerator, stop.is_set)
        if (state.step % config.checkpoint_every == 0 or done or asked_to_stop) and saved_step != state.step:
            _save(run, state)
            saved_step = state.step
            clock.pause()
        if asked_to_stop and not done:
            raise TrainingStopped(f"stopped after step {state.step} of {config.steps}; run again to resume")
    return state


def _step(
    run: _Run, batches: Iterator[PlacedBatch], step: int, clock: Clock
) -> tuple[dict[str, float], float, float, PlacedBatch]:
    """One optimiser step over `accumulate` global batches."""
    config, accelerator = run.config, run.accelerator
    sums: dict[str, torch.Tensor] = {}
    names: list[str] = []
    placed: PlacedBatch | None = None
    for part in range(config.accumulate):
        with clock.waiting():
            placed = next(batches)
        batch = placed.batch.to(accelerator.device, torch.float32)
        generators = sample_generators(config.seed, step * config.accumulate + part, placed.places)
        bfloat16 = run.precision == "bfloat16"
        with torch.autocast(accelerator.device.type, torch.bfloat16, enabled=bfloat16):
            losses = run.task.loss(batch, generators)
        _require_finite(run, losses, batch, step)
        names += batch.names
        (losses.total / config.accumulate).backward()
        for name, value in {"loss": losses.total, **losses.parts}.items():
            sums[name] = sums.get(name, 0.0) + value.detach().float() / config.accumulate
        clock.count(len(placed.batch.ids) * accelerator.num_processes)
    assert placed is not None  # `accumulate` is at least 1
    _average_gradients(run)
    norm = nn.utils.clip_grad_norm_(run.parameters, run.optimizer_config.clip_norm)
    if not bool(torch.isfinite(norm)):  # the same on all ranks; before it reaches weights and checkpoints
        raise NonFiniteLossError(
            f"step {step}: the gradient is {float(norm)} though the loss is finite; samples of this rank: "
            f"{', '.join(names)}; expected a finite number. Look at these samples, or lower optimizer.learning_rate; "
            f"training resumes from the newest checkpoint in {run.checkpoints}"
        )
    rate = run.optimizer_config.rate(step, config.steps)
    for group in run.optimizer.param_groups:
        group["lr"] = rate
    run.optimizer.step()
    run.optimizer.zero_grad(set_to_none=True)
    run.average.update(run.task.module, step + 1)
    means = accelerator.reduce(torch.stack(list(sums.values())), "mean")
    return dict(zip(sums, means.tolist())), float(norm), rate, placed


def _average_gradients(run: _Run) -> None:
    """Mean over ranks, in one reduction. A parameter without gradient on a rank counts as zero there."""
    if run.accelerator.num_processes == 1:
        return
    for parameter in run.parameters:
        if parameter.grad is None:
            parameter.grad = torch.zeros_like(parameter)
    gradients = [parameter.grad for parameter in run.parameters if parameter.grad is not None]
    flat = torch.cat([gradient.reshape(-1) for gradient in gradients])
    flat = run.accelerator.reduce(flat, "mean")
    for gradient, part in zip(gradients, flat.split([g.numel() for g in gradients])):
        gradient.copy_(part.view_as(gradient))


def _require_finite(run: _Run, losses: Losses, batch: Batch, step: int) -> None:
    bad = not bool(torch.isfinite(losses.total))
    if not _any(run.accelerator, bad):
        return
    parts = ", ".join(f"{name} {float(value.detach()):.4g}" for name, value in losses.parts.items())
    whose = f"samples {', '.join(batch.names)}" if bad else "samples of another rank (see its message)"
    raise NonFiniteLossError(
        f"step {step}: the loss is {float(losses.total.detach())} ({parts}) for {whose}; expected a finite number. "
        f"Look at these samples, or lower optimizer.learning_rate; training resumes from the newest checkpoint "
        f"in {run.checkpoints}"
    )


def _validate(run: _Run, step: int, validate: Callable[[], Evaluation]) -> None:
    run.task.module.eval()
    run.average.swap(run.task.module)
    try:
        with torch.no_grad():
            evaluation = validate()
    finally:
        run.average.swap(run.task.module)
    if run.writer is not None:
        for name, value in evaluation.metrics.items():
            if math.isfinite(value):  # else nothing was there to measure
                run.writer.add_scalar(f"validation/{name}", value, step)
        for name, image in evaluation.images.items():
            run.writer.add_image(f"validation/{name}", image, step, dataformats="HWC")


def _step_report(
    run: _Run, step: int, losses: dict[str, float], norm: float, rate: float, clock: Clock
) -> StepReport:
    return StepReport(
        step=step,
        steps=run.config.steps,
        losses=losses,
        learning_rate=rate,
        gradient_norm=norm,
        samples_per_s=clock.samples_per_s(),
        waiting_share=clock.waiting_share(),
    )


def _log(run: _Run, made: StepReport) -> None:
    if run.writer is None:
        return
    for name, value in made.losses.items():
        run.writer.add_scalar(f"training/{name}", value, made.step)
    run.writer.add_scalar("training/learning_rate", made.learning_rate, made.step)
    run.writer.add_scalar("training/gradient_norm", made.gradient_norm, made.step)
    run.writer.add_scalar("speed/samples_per_s", made.samples_per_s, made.step)
    run.writer.add_scalar("speed/waiting_share", made.waiting_share, made.step)


def _save(run: _Run, state: TrainingState) -> None:
    if run.accelerator.is_main_process:
        keep = run.config.keep_checkpoints
        save_checkpoint(run.checkpoints, state, run.task.module, run.average, run.optimizer, keep=keep)
    run.accelerator.wait_for_everyone()


def _any(accelerator: Accelerator, here: bool) -> bool:
    """Whether it holds on any rank."""
    if accelerator.num_processes == 1:
        return here
    flag = torch.tensor([float(here)], device=accelerator.device)
    return bool(accelerator.reduce(flag, "sum").item() > 0)


class _StopFlag:
    """Set by SIGTERM while the context is open."""

    def __init__(self) -> None:
        self.is_set = False

    def __enter__(self) -> "_StopFlag":
        self._before = signal.signal(signal.SIGTERM, self._set)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGTERM, self._before)

    def _set(self, _signal: int, _frame: FrameType | None) -> None:
        self.is_set = True
