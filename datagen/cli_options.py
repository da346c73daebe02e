"""What the commands of `datagen` share: options, error lines, default folders."""

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from datagen.input_error import InputError
from datagen.objects.licences import spdx_of
from datagen.pipeline import PipelineError
from datagen.plan import PlanError
from shards.errors import ShardError
from shards.settings import SettingsError

__all__ = ["config_option", "default_out", "license_option", "out_option", "plain_errors", "workers_option"]

USER_ERRORS = (SettingsError, PlanError, PipelineError, InputError, ShardError)
DEFAULT_CONFIG = Path("configs/datagen/tiny.yaml")

config_option = click.option(
    "--config",
    "config_path",
    type=click.Path(path_type=Path, dir_okay=False),
    default=DEFAULT_CONFIG,
    show_default=True,
    help="Complete YAML configuration.",
)
out_option = click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=None,
    help="Dataset folder.  [default: data/<name of the configuration>]",
)
workers_option = click.option(
    "--workers",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Processes that look at objects.",
)


def _licences(
    _context: click.Context, _parameter: click.Parameter, text: str | None
) -> tuple[str, ...] | None:
    if text is None:
        return None
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    try:
        for name in names:
            spdx_of(name)
    except ValueError as error:
        raise click.BadParameter(str(error)) from error
    return names


license_option = click.option(
    "--license-allow",
    "licence_allow",
    callback=_licences,
    default=None,
    metavar="LIST",
    help="Licences to allow, for example cc0,by.  [default: selection.licence_allow of the configuration]",
)


def plain_errors(command: Callable[..., Any]) -> Callable[..., Any]:
    """What a user can cause ends as one clear message and exit status 2; the rest is a bug and shows a trace."""

    @functools.wraps(command)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        try:
            return command(*args, **kwargs)
        except USER_ERRORS as error:
            click.echo(f"datagen: {error}", err=True)
            sys.exit(2)

    return wrapped


def default_out(config_path: Path) -> Path:
    """Where the Makefile puts it too."""
    return Path("data") / config_path.stem
