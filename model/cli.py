"""The `forehoi` command: parse, call, print. Everything else lives in the modules it calls."""

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
from accelerate import Accelerator
from rich.console import Console
from rich.table import Table

from model.config import TrainingConfig, load_config
from model.errors import ModelError
from model.training.parts import PARTS, train_part
from model.training.progress import TrainingProgress
from model.training.trainer import NonFiniteLossError, TrainingStopped
from shards.errors import ShardError
from shards.settings import SettingsError

__all__ = ["main"]

USER_ERRORS = (SettingsError, ModelError, ShardError, NonFiniteLossError)
DEFAULT_CONFIG = Path("configs/model/tiny.yaml")
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


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="forehoi-open")
def main() -> None:
    """Train the network of ForeHOI on shards of hands that hold objects.

    \b
    Example:
      forehoi train configs/model/tiny.yaml
    """


@main.command()
@click.argument("what", default=str(DEFAULT_CONFIG))
@click.option(
    "--config",
    "config_path",
    type=click.Path(path_type=Path, dir_okay=False),
    default=DEFAULT_CONFIG,
    show_default=True,
    help="Configuration, when WHAT names a part.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=None,
    help="Folder of checkpoints and logs.  [default: runs/<name of the configuration>]",
)
@plain_errors
def train(what: str, config_path: Path, out: Path | None) -> None:
    """Train WHAT: a configuration (all its parts), or one part: vae, hand_encoder, stage_one.

    Continues where it was stopped. Over several processes: torchrun --nproc-per-node N -m model train ...

    \b
    Example:
      forehoi train configs/model/tiny.yaml
      forehoi train hand_encoder --config configs/model/tiny.yaml
    """
    names = (what,) if what in PARTS else PARTS
    path = config_path if what in PARTS else Path(what)
    config = load_config(path)
    folder = out or Path("runs") / path.stem
    accelerator = Accelerator()
    figures = {}
    for name in names:
        with TrainingProgress(name, enabled=accelerator.is_main_process) as bar:
            figures[name] = train_part(name, config, folder, accelerator=accelerator, report=bar.update)
    if accelerator.is_main_process:
        Console().print(_table(config, figures, folder))


def _table(config: TrainingConfig, figures: dict[str, dict[str, float]], folder: Path) -> Table:
    """Figures of every part on held-out cameras of the training motions."""
    table = Table(title=f"{config.name}: figures on held-out cameras", title_justify="left")
    for column in ("part", "figure", "value"):
        table.add_column(column, justify="right" if column == "value" else "left")
    for part, values in figures.items():
        for figure, value in values.items():
            table.add_row(part, figure, f"{value:.3f}")
    table.caption = f"objects are those of the training; checkpoints and TensorBoard logs: {folder}"
    return table
