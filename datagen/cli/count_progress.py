"""A progress bar on standard error over things that are counted; nothing when there is nothing to wait for."""

from types import TracebackType

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

__all__ = ["CountProgress"]


class CountProgress:
    """Context manager. `update` is the `report` of `select_motions`."""

    def __init__(self, what: str) -> None:
        console = Console(stderr=True)
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),  # names may have brackets
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._what = what

    def update(self, done: int, total: int, what: str | None = None) -> None:
        """Move the bar; the first call shows it."""
        if not self._bar.task_ids:
            self._bar.start()
            self._bar.add_task(self._what, total=total)
        self._bar.update(self._bar.task_ids[0], completed=done, total=total, description=what or self._what)

    def print(self, line: str) -> None:
        """A line of results on standard output. The bar goes, until the next `update` begins a new count."""
        self._bar.stop()  # or rich would send the line where the bar is
        for task in self._bar.task_ids:
            self._bar.remove_task(task)
        click.echo(line)

    def __enter__(self) -> "CountProgress":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.stop()
