"""StageClock: how long each stage takes, and who is told that it begins."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import perf_counter

__all__ = ["StageClock"]


class StageClock:
    """Wall-clock seconds by stage, in the order in which stages began."""

    def __init__(self, started: Callable[[str], None] = lambda _: None) -> None:
        self._started = started
        self._seconds: dict[str, float] = {}

    @property
    def seconds(self) -> dict[str, float]:
        """Of the stages that are finished."""
        return dict(self._seconds)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Times the block; a name that comes again adds up."""
        self._started(name)
        begin = perf_counter()
        yield
        self._seconds[name] = self._seconds.get(name, 0.0) + perf_counter() - begin
