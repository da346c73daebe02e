"""How fast a run is, and how much of its time it waits for data."""

import time

__all__ = ["Clock"]


class Clock:
    """Time since the last report: in all, and waiting for data. Validation and saving do not count."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        self._began, self._waited, self._samples = time.perf_counter(), 0.0, 0
        self._last = self._began

    def pause(self) -> None:
        """Forget the time since the last counted batch."""
        self._began += time.perf_counter() - self._last
        self._last = time.perf_counter()

    def count(self, samples: int) -> None:
        self._samples += samples
        self._last = time.perf_counter()

    def waiting(self) -> "_Waiting":
        return _Waiting(self)

    def add_waiting(self, seconds: float) -> None:
        self._waited += seconds

    def samples_per_s(self) -> float:
        return self._samples / max(time.perf_counter() - self._began, 1e-9)

    def waiting_share(self) -> float:
        return self._waited / max(time.perf_counter() - self._began, 1e-9)


class _Waiting:
    def __init__(self, clock: Clock) -> None:
        self._clock = clock

    def __enter__(self) -> None:
        self._began = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self._clock.add_waiting(time.perf_counter() - self._began)
