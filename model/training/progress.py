"""A training's progress on standard error."""

import time
from datetime import timedelta
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from model.training.trainer import RunStarted, StepReport, TrainingEvent

__all__ = ["TrainingProgress"]

_SECONDS_BETWEEN_LINES = 10.0
_SHARE_BETWEEN_LINES = 0.05  # of the time so far: a long run prints fewer


class TrainingProgress:
    """A bar with losses, samples per second and remaining time; on a plain stream a line now and then."""

    def __init__(self, name: str, *, enabled: bool) -> None:
        self._name, self._enabled = name, enabled
        self._console = Console(stderr=True)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=self._console,
            transient=True,
            disable=not (enabled and self._console.is_terminal),
        )
        self._task = self._bar.add_task(f"{name}: preparing networks and data", total=None)
        self._began = self._last_line = time.monotonic()
        self._first_step = 0  # of this process; more when a run is resumed

    def update(self, event: TrainingEvent) -> None:
        """Show one event."""
        if isinstance(event, RunStarted):
            self._start(event)
        else:
            self._step(event)

    def _start(self, started: RunStarted) -> None:
        self._began, self._first_step = time.monotonic(), started.step
        self._bar.update(self._task, completed=started.step, total=started.steps)
        for notice in started.notices:
            self._print(f"{self._name}: {notice}")

    def _step(self, report: StepReport) -> None:
        losses = ", ".join(f"{name} {value:.4f}" for name, value in report.losses.items())
        waiting = f", waiting {report.waiting_share:.0%}" if report.waiting_share > 0.05 else ""
        line = f"{self._name}: {losses}, {report.samples_per_s:.1f} samples/s{waiting}"
        self._bar.update(self._task, completed=report.step, description=line)
        if self._console.is_terminal or not self._due(report):
            return
        remaining = timedelta(seconds=round(self._remaining_s(report)))
        self._print(f"{line}, step {report.step} of {report.steps}, remaining {remaining}")
        self._last_line = time.monotonic()

    def _due(self, report: StepReport) -> bool:
        """After the first step, so that a user soon sees how long it will take; at the end; else now and then."""
        if report.step in (self._first_step + 1, report.steps):
            return True
        now = time.monotonic()
        pause = max(_SECONDS_BETWEEN_LINES, _SHARE_BETWEEN_LINES * (now - self._began))
        return now - self._last_line >= pause

    def _remaining_s(self, report: StepReport) -> float:
        per_step = (time.monotonic() - self._began) / (report.step - self._first_step)
        return per_step * (report.steps - report.step)

    def _print(self, line: str) -> None:
        if self._enabled:
            self._console.print(line, soft_wrap=True, highlight=False)

    def __enter__(self) -> "TrainingProgress":
        if not self._console.is_terminal:
            self._print(f"{self._name}: preparing networks and data")
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.stop()
