"""A training's progress on standard error."""

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from model.training.trainer import StepReport

__all__ = ["TrainingProgress"]


class TrainingProgress:
    """A bar with losses, samples per second and remaining time; on a plain stream a line now and then."""

    LINES = 10  # in a whole run, where no terminal shows the bar

    def __init__(self, name: str, *, enabled: bool) -> None:
        self._name, self._enabled = name, enabled
        self._lines = 0
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
        self._task = self._bar.add_task(name, total=None)

    def update(self, report: StepReport) -> None:
        """Show one report."""
        losses = ", ".join(f"{name} {value:.4f}" for name, value in report.losses.items())
        waiting = f", waiting {report.waiting_share:.0%}" if report.waiting_share > 0.05 else ""
        line = f"{self._name}: {losses}, {report.samples_per_s:.1f} samples/s{waiting}"
        self._bar.update(self._task, completed=report.step, total=report.steps, description=line)
        lines = report.step * self.LINES // report.steps
        if self._enabled and not self._console.is_terminal and lines > self._lines:
            self._lines = lines
            self._console.print(f"{line}, step {report.step} of {report.steps}", soft_wrap=True)

    def __enter__(self) -> "TrainingProgress":
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.stop()
