"""Without a terminal, too, a user soon sees that a training runs and how long it will take."""

import re

from model.training.progress import TrainingProgress
from model.training.trainer import RunStarted, StepReport


def step(number: int, steps: int = 1000) -> StepReport:
    return StepReport(
        step=number,
        steps=steps,
        losses={"loss": 0.5},
        learning_rate=0.1,
        gradient_norm=1.0,
        samples_per_s=2.0,
        waiting_share=0.0,
    )


def lines(capsys) -> list[str]:
    return capsys.readouterr().err.splitlines()


def test_the_start_the_notices_the_first_and_the_last_step_are_said(capsys) -> None:
    with TrainingProgress("vae", enabled=True) as progress:
        assert lines(capsys) == ["vae: preparing networks and data"]
        progress.update(RunStarted(step=0, steps=1000, notices=("precision: float32 (why)",)))
        assert lines(capsys) == ["vae: precision: float32 (why)"]
        for number in range(1, 1001):
            progress.update(step(number))
    first, last = lines(capsys)
    assert re.fullmatch(r"vae: loss 0\.5000, 2\.0 samples/s, step 1 of 1000, remaining \d+:\d\d:\d\d", first)
    assert last.endswith("step 1000 of 1000, remaining 0:00:00")


def test_remaining_time_is_that_of_the_steps_of_this_process(capsys, monkeypatch) -> None:
    now = [100.0]
    monkeypatch.setattr("model.training.progress.time.monotonic", lambda: now[0])
    progress = TrainingProgress("vae", enabled=True)
    progress.update(RunStarted(step=500, steps=1000, notices=()))
    for number in (501, 502, 503, 504):
        now[0] += 4.0
        progress.update(step(number))
    first, fourth = lines(capsys)  # ten seconds lie between lines
    assert first.endswith(f"remaining 0:{499 * 4 // 60:02d}:{499 * 4 % 60:02d}")
    assert fourth.endswith(f"remaining 0:{496 * 4 // 60:02d}:{496 * 4 % 60:02d}")


def test_other_ranks_are_silent(capsys) -> None:
    with TrainingProgress("vae", enabled=False) as progress:
        progress.update(RunStarted(step=0, steps=10, notices=("precision: float32",)))
        progress.update(step(1, 10))
    assert lines(capsys) == []
