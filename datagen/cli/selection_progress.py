"""A progress bar on standard error while objects are looked at; nothing when there is nothing to wait for."""

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

__all__ = ["SelectionProgress"]


class SelectionProgress:
    """Context manager; `update` is the `report` of `select_motions`."""

    def __init__(self, what: str = "looking at objects") -> None:
        console = Console(stderr=True)
        self._bar = Progress(
            TextColumn("{task.description}"),
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

    def __enter__(self) -> "SelectionProgress":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.stop()
