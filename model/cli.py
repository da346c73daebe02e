"""The `forehoi` command: parse, call, print. Everything else lives in the modules it calls."""

from pathlib import Path

import click
from accelerate import Accelerator
from rich.console import Console
from rich.table import Table

from model.cli_options import plain_errors
from model.cli_reconstruct import reconstruct_command
from model.cli_weights import weights
from model.config import TrainingConfig, load_config
from model.training.parts import PARTS, train_part, trained_parts
from model.training.progress import TrainingProgress

__all__ = ["main"]

DEFAULT_CONFIG = Path("configs/model/tiny.yaml")


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="forehoi-open")
def main() -> None:
    """Train the network of ForeHOI on shards of hands that hold objects.

    \b
    Example:
      forehoi train configs/model/tiny.yaml
    """


main.add_command(weights)
main.add_command(reconstruct_command)


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
    """Train WHAT: a configuration (all parts that it trains), or one part: vae, hand_encoder, stage_one.

    Continues where it was stopped. Over several processes: torchrun --nproc-per-node N -m model train ...

    \b
    Example:
      forehoi train configs/model/tiny.yaml
      forehoi train hand_encoder --config configs/model/tiny.yaml
    """
    path = config_path if what in PARTS else Path(what)
    config = load_config(path)
    names = (what,) if what in PARTS else trained_parts(config)
    folder = out or Path("runs") / path.stem
    accelerator = Accelerator()
    figures = {}
    for name in names:
        with TrainingProgress(name, enabled=accelerator.is_main_process) as bar:
            figures[name] = train_part(name, config, folder, accelerator=accelerator, report=bar.update)
    if accelerator.is_main_process:
        Console().print(_table(config, figures, folder))


def _table(config: TrainingConfig, figures: dict[str, dict[str, float]], folder: Path) -> Table:
    """Figures of every part, and what they were measured on."""
    same = config.validation.split == config.data.split
    where = "held-out cameras" if same else f"objects of the {config.validation.split} split"
    table = Table(title=f"{config.name}: figures on {where}", title_justify="left")
    for column in ("part", "figure", "value"):
        table.add_column(column, justify="right" if column == "value" else "left")
    for part, values in figures.items():
        for figure, value in values.items():
            table.add_row(part, figure, f"{value:.3f}")
    seen = "objects are those of the training" if same else "none of these objects was trained on"
    table.caption = f"{seen}; checkpoints and TensorBoard logs: {folder}"
    return table
