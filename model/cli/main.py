"""The `forehoi` command: parse, call, print. Everything else lives in the modules it calls."""

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
from model.recipes.components.component import Component
from model.recipes.config import COMPONENT_NAMES, PRESETS, TrainingConfig, load_config
from model.recipes.train_component import train_component
from model.training.progress import TrainingProgress
from shards.configuration.presets import preset_names
from shards.settings import did_you_mean

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
    help="Preset or YAML file, when WHAT names a component.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=None,
    help="Folder of checkpoints and logs.  [default: runs/NAME for a configuration NAME.yaml]",
)
@plain_errors
def train(what: str, config_name: str, out: Path | None) -> None:
    """Train WHAT: a preset or a YAML file (all components that it trains), or one component of it.

    Components of stage 1: vae, hand_encoder, stage_one; of stage 2: slat_vae, slat_flow.

    Continues where it was stopped. Over several processes: torchrun --nproc-per-node N -m model train ...

    \b
    Example:
      forehoi train tiny
      forehoi train hand_encoder --config hands
    """
    is_component = what in COMPONENT_NAMES
    if not is_component:
        _refuse_unknown_name(what)
    name_or_file = config_name if is_component else what
    config = load_config(name_or_file)
    components = (_component(config, what, name_or_file),) if is_component else _to_train(config)
    folder = out or Path("runs") / Path(name_or_file).stem
    accelerator = Accelerator()
    metrics = {}
    for component in components:
        with TrainingProgress(component.name, enabled=accelerator.is_main_process) as bar:
            metrics[component.name] = train_component(
                component, config, folder, accelerator=accelerator, report=bar.update
            )
    if accelerator.is_main_process:
        Console().print(_table(config, metrics, folder))


def _refuse_unknown_name(what: str) -> None:
    """A name without slash and suffix is that of a preset or of a component."""
    presets = preset_names(PRESETS)
    if "/" not in what and not Path(what).suffix and what not in presets:
        raise ModelError(
            what,
            f"neither a preset nor a component{did_you_mean(what, (*COMPONENT_NAMES, *presets))}",
            expected=f"a preset ({', '.join(presets)}) or a component ({', '.join(COMPONENT_NAMES)})",
            action=f"Correct it, or name a file with its suffix or a slash: {what}.yaml, ./{what}",
        )


def _to_train(config: TrainingConfig) -> tuple[Component, ...]:
    return tuple(component for component in config.components() if component.recipe is not None)


def _component(config: TrainingConfig, name: str, source: str) -> Component:
    """The one of this name, if the configuration has it."""
    components = {component.name: component for component in config.components()}
    if name not in components:
        raise ModelError(
            source,
            f"has no {name} to train",
            expected=f"a component: {', '.join(components)}",
            action="Give the other --config.",
        )
    return components[name]


def _table(config: TrainingConfig, metrics: dict[str, dict[str, float]], folder: Path) -> Table:
    """Metrics of every component, and what they were measured on."""
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
