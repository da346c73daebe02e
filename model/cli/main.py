"""The `forehoi` command: parse, call, print. Everything else lives in the modules it calls."""

from collections.abc import Callable
from pathlib import Path

import click
from accelerate import Accelerator
from rich.console import Console
from rich.table import Table

from model.cli.config_command import config_command
from model.cli.metrics_table import metrics_table
from model.cli.options import plain_errors
from model.cli.reconstruct import reconstruct_command
from model.cli.weights import weights
from model.errors import ModelError
from model.recipes.components import PARTS, train_part, trained_parts
from model.recipes.config import TrainingConfig
from model.recipes.slat_components import SLAT_PARTS, train_slat_part, trained_slat_parts
from model.recipes.slat_config import SlatTrainingConfig, load_any_config
from model.training.progress import TrainingProgress
from model.training.trainer import TrainingEvent

__all__ = ["main"]

DEFAULT_CONFIG = "tiny"


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="forehoi-open")
def main() -> None:
    """Train the network of ForeHOI on shards of hands that hold objects.

    \b
    Example:
      forehoi train tiny
    """


main.add_command(config_command)
main.add_command(weights)
main.add_command(reconstruct_command)


@main.command()
@click.argument("what", default=DEFAULT_CONFIG)
@click.option(
    "--config",
    "config_name",
    metavar="NAME|FILE",
    default=DEFAULT_CONFIG,
    show_default=True,
    help="Preset or YAML file, when WHAT names a part.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=None,
    help="Folder of checkpoints and logs.  [default: runs/NAME for a configuration NAME.yaml]",
)
@plain_errors
def train(what: str, config_name: str, out: Path | None) -> None:
    """Train WHAT: a preset or a YAML file (all parts that it trains), or one part of it.

    Parts of stage 1: vae, hand_encoder, stage_one; of stage 2: slat_vae, slat_flow.

    Continues where it was stopped. Over several processes: torchrun --nproc-per-node N -m model train ...

    \b
    Example:
      forehoi train tiny
      forehoi train hand_encoder --config hands
    """
    one_part = what in (*PARTS, *SLAT_PARTS)
    name_or_file = config_name if one_part else what
    config = load_any_config(name_or_file)
    names = trained_slat_parts(config) if isinstance(config, SlatTrainingConfig) else trained_parts(config)
    if one_part:
        names = (_part_of(config, what, name_or_file),)
    folder = out or Path("runs") / Path(name_or_file).stem
    accelerator = Accelerator()
    metrics = {}
    for name in names:
        with TrainingProgress(name, enabled=accelerator.is_main_process) as bar:
            metrics[name] = _train(name, config, folder, accelerator, bar.update)
    if accelerator.is_main_process:
        Console().print(_table(config, metrics, folder))


def _part_of(config: TrainingConfig | SlatTrainingConfig, name: str, source: str) -> str:
    """The name, if it is a part of this configuration's stage."""
    parts = SLAT_PARTS if isinstance(config, SlatTrainingConfig) else PARTS
    if name not in parts:
        raise ModelError(
            source,
            f"has no {name}",
            expected=f"a part: {', '.join(parts)}",
            action="Give the other --config.",
        )
    return name


def _train(
    name: str,
    config: TrainingConfig | SlatTrainingConfig,
    folder: Path,
    accelerator: Accelerator,
    report: Callable[[TrainingEvent], None],
) -> dict[str, float]:
    if isinstance(config, SlatTrainingConfig):
        return train_slat_part(name, config, folder, accelerator=accelerator, report=report)
    return train_part(name, config, folder, accelerator=accelerator, report=report)


def _table(
    config: TrainingConfig | SlatTrainingConfig, metrics: dict[str, dict[str, float]], folder: Path
) -> Table:
    """Metrics of every part, and what they were measured on."""
    same = config.validation.split == config.data.split
    where = (
        "held-out cameras of the training motions"
        if same
        else f"objects of the {config.validation.split} split"
    )
    seen = "the objects are those of the training" if same else "none of these objects was trained on"
    return metrics_table(
        f"{config.name}: metrics on {where}", metrics, f"{seen}; checkpoints and TensorBoard logs: {folder}"
    )
