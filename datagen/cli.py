"""The `datagen` command: parse, call, print. Everything else lives in the modules it calls."""

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from datagen.config import load_config
from datagen.objects.errors import ObjectError
from datagen.pipeline import PipelineError, RenderOptions, plan_dataset, render_shard
from datagen.plan import PlanError
from datagen.render_progress import RenderProgress
from datagen.version import generator_commit
from shards.errors import ShardError
from shards.settings import SettingsError

__all__ = ["main"]

USER_ERRORS = (SettingsError, PlanError, PipelineError, ObjectError, ShardError)
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


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="forehoi-open")
def main() -> None:
    """Make and check datasets of hands that hold objects.

    \b
    Example:
      datagen render --shard 0
      datagen inspect shard 0
    """


@main.command()
@config_option
@out_option
@plain_errors
def plan(config_path: Path, out: Path | None) -> None:
    """Decide what to render: write dataset.json and plan.parquet.

    \b
    Example:
      datagen plan --config configs/datagen/paper.yaml --out data/paper
    """
    from datagen.inspection.plan_table import plan_table

    config = load_config(config_path)
    out = out or default_out(config_path)
    made = plan_dataset(config, out, commit=generator_commit())
    Console().print(plan_table(made, config, out))


@main.command()
@config_option
@out_option
@click.option("--shard", type=int, required=True, help="Which shard of the plan to render.")
@click.option(
    "--device",
    type=click.Choice(["auto", "cpu", "cuda", "optix", "hip", "metal"]),
    default="auto",
    show_default=True,
    help="What Cycles renders on. auto takes the fastest found; a named device must exist.",
)
@click.option("--workers", type=click.IntRange(min=1), default=1, show_default=True, help="Motions at a time.")
@click.option("--threads", type=click.IntRange(min=1), default=None, help="Render threads of each worker.")
@plain_errors
def render(config_path: Path, out: Path | None, shard: int, device: str, workers: int, threads: int | None) -> None:
    """Render one shard, or what is missing of it, and verify it.

    \b
    Example:
      datagen render --config configs/datagen/tiny.yaml --shard 0
    """
    config = load_config(config_path)
    out = out or default_out(config_path)
    made = plan_dataset(config, out, commit=generator_commit())
    options = RenderOptions(device=device, workers=workers, threads_per_worker=threads)
    with RenderProgress(made.shard(shard)) as progress:
        summary = render_shard(config_path, config, made, out, shard, options, progress.update)
    click.echo(summary.one_line())
    click.echo(f"look at it: datagen inspect shard {shard} --out {out} --sheet sheet.png")


def default_out(config_path: Path) -> Path:
    """Where the Makefile puts it too."""
    return Path("data") / config_path.stem
