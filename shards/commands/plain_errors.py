"""How the commands of both workshops end when the user can do something about it."""

import functools
import sys
from collections.abc import Callable, Mapping
from typing import ParamSpec, TypeVar

__all__ = ["plain_errors"]

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def plain_errors(
    program: str, exit_statuses: Mapping[type[Exception], int]
) -> Callable[[Callable[Parameters, Result]], Callable[Parameters, Result]]:
    """Decorates a command: these exceptions end it with one message and their exit status.

    Any other is a bug and shows a trace.
    """

    def decorate(command: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
        @functools.wraps(command)
        def wrapped(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
            try:
                return command(*args, **kwargs)
            except tuple(exit_statuses) as error:
                sys.stderr.write(f"{program}: {error}\n")
                sys.exit(next(status for kind, status in exit_statuses.items() if isinstance(error, kind)))

        return wrapped

    return decorate
