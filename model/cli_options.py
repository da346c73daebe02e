"""What the commands share."""

import functools
import sys
from collections.abc import Callable
from typing import Any

import click

from model.errors import ModelError
from model.training.trainer import NonFiniteLossError, TrainingStopped
from shards.errors import ShardError
from shards.settings import SettingsError

__all__ = ["plain_errors"]

USER_ERRORS = (SettingsError, ModelError, ShardError, NonFiniteLossError)
STOPPED = 143  # as a process that SIGTERM ended; here after saving


def plain_errors(command: Callable[..., Any]) -> Callable[..., Any]:
    """What a user can cause ends as one clear message and exit status 2; the rest is a bug and shows a trace."""

    @functools.wraps(command)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        try:
            return command(*args, **kwargs)
        except USER_ERRORS as error:
            click.echo(f"forehoi: {error}", err=True)
            sys.exit(2)
        except TrainingStopped as stopped:
            click.echo(f"forehoi: {stopped}", err=True)
            sys.exit(STOPPED)

    return wrapped
