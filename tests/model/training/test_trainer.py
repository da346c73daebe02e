"""Training resumes exactly, is the same on any number of ranks, and stops with a reason."""

import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from model.errors import ModelError
from model.training.checkpoint import latest_checkpoint, load_average, read_state
from model.training.config import TrainerConfig
from model.training.task import Evaluation
from model.training.trainer import (
    NonFiniteLossError,
    RunStarted,
    StepReport,
    TrainingEvent,
    TrainingStopped,
    train,
)
from tests.model.training.toy import OPTIMIZER, ToySource, ToyTask, settings

ROOT = Path(__file__).resolve().parents[3]
TOY = Path(__file__).with_name("toy.py")


def run(
    folder: Path,
    config: TrainerConfig,
    *,
    source: ToySource | None = None,
    sha: str = "toy",
    yaml: str = "toy",
    **options,
):
    task = ToyTask()
    source = source or ToySource(4)
    state = train(
        task,
        source,
        config,
        OPTIMIZER,
        folder=folder,
        config_yaml=yaml,
        config_sha256=sha,
        **options,
    )
    return task, state, source


def run_steps(folder: Path, config: TrainerConfig, **options) -> list[StepReport]:
    """The reports of a run's steps."""
    events: list[TrainingEvent] = []
    run(folder, config, report=events.append, **options)
    return [event for event in events if isinstance(event, StepReport)]


def newest(folder: Path) -> Path:
    """The newest checkpoint of a run; there has to be one."""
    path = latest_checkpoint(folder / "checkpoints")
    assert path is not None
    return path


def tensors(folder: Path) -> dict[str, torch.Tensor]:
    path = newest(folder)
    return {
        f"{file.stem}/{name}": value
        for file in sorted(path.glob("*.safetensors"))
        for name, value in load_file(file).items()
    }


def assert_same_tensors(a: Path, b: Path, *, rtol: float = 0.0, atol: float = 0.0) -> None:
    left, right = tensors(a), tensors(b)
    assert left.keys() == right.keys()
    for name in left:
        torch.testing.assert_close(left[name], right[name], rtol=rtol, atol=atol)


@pytest.mark.parametrize("steps", [(4, 10), (7, 10), (1, 10)])
def test_k_steps_and_a_resume_equal_a_run_in_one_go_bit_for_bit(tmp_path, steps):
    """Weights, averages, optimiser, buffers and the position in the data."""
    first, last = steps
    run(tmp_path / "whole", settings(last))
    part = settings(last, checkpoint_every=1)

    class StopError(Exception):
        pass

    def stop(report: TrainingEvent) -> None:
        if report.step == first + 1:
            raise StopError

    with pytest.raises(StopError):
        run(tmp_path / "parts", part, report=stop)
    _, state, source = run(tmp_path / "parts", part)
    assert state.step == last
    assert source.seen[0] == 4 * first  # not one sample twice
    assert_same_tensors(tmp_path / "whole", tmp_path / "parts")


def test_a_run_says_and_records_its_machine_and_what_is_new_where_it_is_resumed(tmp_path):
    def notices(steps: int) -> tuple[str, ...]:
        events: list[TrainingEvent] = []
        run(tmp_path, settings(steps, precision="auto"), report=events.append)
        (started,) = (event for event in events if isinstance(event, RunStarted))
        return started.notices

    (first,) = notices(4)
    state_file = newest(tmp_path) / "state.json"
    machine = json.loads(state_file.read_text())["machine"]
    assert f"precision: {machine['precision']} (" in first
    assert notices(8) == (f"precision: {machine['precision']}, as before on this kind of machine",)

    state_file = newest(tmp_path) / "state.json"
    state = json.loads(state_file.read_text())
    state["machine"]["processor"] = "Another Processor"
    state_file.write_text(json.dumps(state))
    _, changed = notices(12)
    assert changed.startswith("resumed on another kind of machine: processor Another Processor -> ")
    assert read_state(newest(tmp_path)).machine.processor == machine["processor"]


def test_a_finished_run_is_left_alone(tmp_path):
    run(tmp_path, settings(5))
    before = newest(tmp_path).stat().st_mtime_ns
    _, state, source = run(tmp_path, settings(5))
    assert (state.step, source.seen) == (5, [])
    assert newest(tmp_path).stat().st_mtime_ns == before


def test_the_loss_falls(tmp_path):
    losses = [report.losses["loss"] for report in run_steps(tmp_path, settings(60))]
    assert sum(losses[-10:]) < 0.2 * sum(losses[:10])


def test_two_half_batches_accumulated_equal_one_batch(tmp_path):
    """The noise differs (it belongs to the place in the batch), so only its size is compared."""
    halves = run_steps(tmp_path / "a", settings(6, accumulate=2), source=ToySource(2))
    whole = run_steps(tmp_path / "b", settings(6), source=ToySource(4))
    norms = [report.gradient_norm for report in whole]
    assert [report.gradient_norm for report in halves] == pytest.approx(norms, rel=0.5)
    assert read_state(newest(tmp_path / "a")).samples_consumed == 12


def torchrun(folder: Path, ranks: int, steps: int) -> None:
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={ranks}"]
    command += [str(TOY), str(folder), str(steps), "4"]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_two_processes_give_the_result_of_one_and_go_on_from_it(tmp_path):
    """1 -> 2 -> 1 ranks; sums in another order may change last bits."""
    run(tmp_path / "one", settings(10))
    torchrun(tmp_path / "two", 2, 10)
    assert_same_tensors(tmp_path / "one", tmp_path / "two", rtol=1e-4, atol=1e-6)
    assert len(list((tmp_path / "two" / "checkpoints").iterdir())) == 2  # only one rank writes


def test_sigterm_saves_and_the_next_run_goes_on(tmp_path):
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, str(TOY), str(tmp_path / "killed"), "40", "4", "slow"],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    for line in process.stdout:
        if line.strip() == "6":
            break
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert "TrainingStopped" in errors
    stopped = read_state(newest(tmp_path / "killed"))
    assert 6 <= stopped.step < 40
    run(tmp_path / "killed", settings(40))
    run(tmp_path / "whole", settings(40))
    assert_same_tensors(tmp_path / "whole", tmp_path / "killed")


def test_nan_stops_with_motions_clips_and_frames_named_and_the_last_good_state_kept(tmp_path):
    named = r"toy:2:29 \(clip-29 frame 0, clip-29 frame 7\)"
    with pytest.raises(NonFiniteLossError, match=rf"the loss is nan .*samples .*{named}.*newest checkpoint"):
        run(tmp_path, settings(20), source=ToySource(4, poison=29))
    state = read_state(newest(tmp_path))
    assert state.step == 4
    assert all(torch.isfinite(value).all() for value in tensors(tmp_path).values())


class _GradientOverflows(ToyTask):
    """The loss is finite, its gradient at step 5 is not: sqrt at zero."""

    calls = 0

    def loss(self, batch, generators):
        losses = super().loss(batch, generators)
        self.calls += 1
        if self.calls <= 5:
            return losses
        parameter = next(self.module.parameters())
        return replace(losses, total=losses.total + (0.0 * parameter.sum()).sqrt())


def test_a_gradient_that_is_not_finite_stops_before_it_reaches_the_weights(tmp_path):
    with pytest.raises(
        NonFiniteLossError, match=r"step 5: the gradient is nan .*toy:1:\d+ \(clip-.*newest checkpoint"
    ):
        train(
            _GradientOverflows(),
            ToySource(4),
            settings(20),
            OPTIMIZER,
            folder=tmp_path,
            config_yaml="toy",
            config_sha256="toy",
        )
    assert read_state(newest(tmp_path)).step == 4
    assert all(torch.isfinite(value).all() for value in tensors(tmp_path).values())


def test_validation_uses_the_averaged_weights_and_takes_them_back(tmp_path):
    seen: list[dict[str, torch.Tensor]] = []
    task = ToyTask()

    def validate():
        seen.append({name: p.detach().clone() for name, p in task.module.named_parameters()})
        return task.measure([next(ToySource(2).batches(0, 0)).batch]).evaluation()

    train(
        task,
        ToySource(4),
        settings(8, validate_every=8),
        OPTIMIZER,
        folder=tmp_path,
        config_yaml="toy",
        config_sha256="toy",
        validate=validate,
    )
    saved = tensors(tmp_path)
    for name, value in seen[0].items():
        torch.testing.assert_close(value, saved[f"average/{name}"], rtol=0.0, atol=0.0)
    for name, parameter in task.module.named_parameters():
        torch.testing.assert_close(parameter.detach(), saved[f"weights/{name}"], rtol=0.0, atol=0.0)
    other = ToyTask()
    load_average(newest(tmp_path), other.module)
    for name, parameter in other.module.named_parameters():
        torch.testing.assert_close(parameter.detach(), saved[f"average/{name}"])


def test_another_configuration_is_refused(tmp_path):
    run(tmp_path, settings(4))
    with pytest.raises(ModelError, match="was trained with another configuration"):
        run(tmp_path, settings(8), sha="other")


def test_other_data_are_refused_and_a_run_that_goes_on_keeps_the_configuration_of_now(tmp_path):
    """The text holds bookkeeping and places, which may change; what decides is in its digest."""
    run(tmp_path, settings(4), yaml="before")
    with pytest.raises(
        ModelError, match=r"step-00000004: was trained on other data \(colours\).*wherever they"
    ):
        run(tmp_path, settings(8), source=ToySource(4, data_sha256="greys"))
    run(tmp_path, settings(8), yaml="after")
    state = read_state(newest(tmp_path))
    assert (state.step, state.config_yaml, state.data_sha256) == (8, "after", "colours")


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda p: (p / "state.json").write_text("{"), "is no checkpoint"),
        (lambda p: (p / "weights.safetensors").write_bytes(b"123"), r"weights\.safetensors: cannot be read"),
        (
            lambda p: (p / "state.json").write_text(
                json.dumps(json.loads((p / "state.json").read_text()) | {"format_version": 9})
            ),
            "has checkpoint format 9",
        ),
    ],
)
def test_a_damaged_checkpoint_is_one_line(tmp_path, spoil, message):
    run(tmp_path, settings(4))
    spoil(newest(tmp_path))
    with pytest.raises(ModelError, match=message) as error:
        run(tmp_path, settings(8))
    assert "\n" not in str(error.value)


def test_a_half_written_checkpoint_does_not_count(tmp_path):
    run(tmp_path, settings(8))
    folder = tmp_path / "checkpoints"
    (folder / ".step-00000099.partial").mkdir()
    (folder / "notes").mkdir()
    assert latest_checkpoint(folder).name == "step-00000008"
    assert sorted(p.name for p in folder.glob("step-*")) == ["step-00000004", "step-00000008"]


def test_what_a_killed_process_left_half_written_is_deleted_and_nothing_else(tmp_path):
    folder = tmp_path / "checkpoints"
    others = [folder / "notes", folder / ".step-1.partial", tmp_path / ".step-00000099.partial"]
    for steps in (4, 8):  # a run that begins, a run that resumes
        for path in (folder / ".step-00000099.partial", *others):
            path.mkdir(parents=True, exist_ok=True)
            (path / "weights.safetensors").write_bytes(b"half")
        run(tmp_path, settings(steps))
        assert not (folder / ".step-00000099.partial").exists()
        assert all((path / "weights.safetensors").exists() for path in others)


@pytest.mark.parametrize("end", ["nan", "sigterm"])
def test_the_log_is_written_and_what_loads_the_batches_is_closed_however_a_run_ends(tmp_path, end):
    closed: list[bool] = []

    class Watched(ToySource):
        def batches(self, epoch, samples_consumed):
            try:
                yield from super().batches(epoch, samples_consumed)
            finally:
                closed.append(True)

    def report(made: TrainingEvent) -> None:
        if made.step == 5 and end == "sigterm":
            signal.raise_signal(signal.SIGTERM)

    expected = NonFiniteLossError if end == "nan" else TrainingStopped
    source = Watched(4, poison=20 if end == "nan" else None)
    threads = threading.active_count()
    with pytest.raises(expected) as caught:
        run(tmp_path, settings(20), source=source, report=report)
    assert closed == [True]
    assert threading.active_count() == threads  # the log's writer has one
    assert caught.value.__traceback__ is not None  # which keeps alive what its frames hold
    log = EventAccumulator(str(tmp_path / "tensorboard")).Reload()  # what is in the file by now
    assert [event.step for event in log.Scalars("training/loss")] == [1, 2, 3, 4, 5]


def test_a_metric_without_a_number_is_not_logged(tmp_path):
    evaluation = Evaluation(metrics={"known": 1.5, "nothing": math.nan, "endless": math.inf}, images={})
    run(tmp_path, settings(4, validate_every=4), validate=lambda: evaluation)
    log = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [tag for tag in log.Tags()["scalars"] if tag.startswith("validation/")] == ["validation/known"]


def test_waiting_and_speed_are_reported(tmp_path):
    class Slow(ToySource):
        def batches(self, epoch, samples_consumed):
            for placed in super().batches(epoch, samples_consumed):
                time.sleep(0.05)
                yield placed

    for report in run_steps(tmp_path, settings(4), source=Slow(4)):
        step_s = 4 / report.samples_per_s
        assert step_s > 0.05
        # However slow the rest of a step is. A half for the moment between reading the one and the other.
        assert 0.5 * 0.05 <= report.waiting_share * step_s <= step_s
