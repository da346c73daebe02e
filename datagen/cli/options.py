"""What the commands of `datagen` share: options, error lines, default folders."""

from pathlib import Path

import click

from datagen.input_error import InputError
from datagen.jobs.render_shard import PipelineError
from datagen.objects.catalogue.licences import spdx_of
from datagen.plan.plan import PlanError
from shards.commands.plain_errors import plain_errors as plain_errors_of
from shards.errors import ShardError
from shards.settings import SettingsError

__all__ = ["config_option", "default_out", "license_option", "out_option", "plain_errors", "workers_option"]

USER_ERRORS = (SettingsError, PlanError, PipelineError, InputError, ShardError)
DEFAULT_CONFIG = "tiny"

plain_errors = plain_errors_of("datagen", dict.fromkeys(USER_ERRORS, 2))

config_option = click.option(
    "--config",
    "config_name",
    metavar="NAME|FILE",
    default=DEFAULT_CONFIG,
    show_default=True,
    help="Preset, or YAML file of your own (`datagen config` prints them).",
)
out_option = click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=None,
    help="Dataset folder.  [default: data/NAME for a configuration NAME.yaml]",
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


def default_out(config_name: str) -> Path:
    """Where the Makefile puts it too."""
    return Path("data") / Path(config_name).stem
