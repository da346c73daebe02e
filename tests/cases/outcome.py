"""What becomes of a folder of files from the field: read right, refused in one line, wrong, or a traceback."""

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from datagen.cli.options import USER_ERRORS as DATAGEN_ERRORS
from model.cli.options import USER_ERRORS as MODEL_ERRORS

__all__ = ["TIME_LIMIT_S", "Case", "Outcome", "Status", "outcome_of"]

Status = Literal["right", "refused", "wrong", "traceback"]

TIME_LIMIT_S = 60.0
PLAIN_ERRORS = (*DATAGEN_ERRORS, *MODEL_ERRORS)  # what the commands show as one line


@dataclass(frozen=True, kw_only=True)
class Case:
    """One statement about a folder of case files.

    `check` gets the folder, asserts what is right and returns one short line on what it found. A plain error of the
    project that it lets through is right only where `refused_is_right`.
    """

    folder: str
    what: str
    check: Callable[[Path], str]
    refused_is_right: bool = False


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of a case. `line` says what was found, or what the error said."""

    case: str
    status: Status
    line: str
    seconds: float

    @property
    def is_good(self) -> bool:
        return self.status in ("right", "refused")


def outcome_of(case: Case, root: Path, *, limit_s: float = TIME_LIMIT_S) -> Outcome:
    """Run one case on its folder below `root`, for at most `limit_s` seconds. Never raises what the check raises."""
    start = time.monotonic()
    status, line = _checked(case, root / case.folder, limit_s)
    return Outcome(case=case.folder, status=status, line=line, seconds=time.monotonic() - start)


class _TooSlowError(BaseException):
    """Not an Exception: nothing between the check and here may take it for an error of the file."""


def _checked(case: Case, folder: Path, limit_s: float) -> tuple[Status, str]:
    if not folder.is_dir():
        return "wrong", "there is no such folder"
    try:
        with _time_limit(limit_s):
            return "right", f"{case.what}: {case.check(folder)}"
    except _TooSlowError:
        return "wrong", f"not finished after {limit_s:g} s"
    except AssertionError as error:
        return "wrong", f"{case.what}: {_one_line(error)}"
    except PLAIN_ERRORS as error:
        if "\n" in str(error):
            return "wrong", f"refused in several lines: {_one_line(error)}"
        return "refused" if case.refused_is_right else "wrong", str(error)
    except Exception as error:  # a bug, which the table shows instead of ending
        return "traceback", f"{type(error).__name__}: {_one_line(error)}"


@contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    """Raises after `seconds`, as soon as Python code runs again."""

    def too_slow(_number: int, _frame: object) -> None:
        raise _TooSlowError

    before = signal.signal(signal.SIGALRM, too_slow)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:300]
