"""`forehoi weights`: published weights in, trained adapters out."""

from pathlib import Path

import click
from rich.console import Console
from rich.table import Table
from rich.text import Text

from model.cli.options import plain_errors
from model.recipes.config import load_config
from model.recipes.merging import export_run_adapter, merge_run
from model.weights.importing import ImportReport, import_networks
from model.weights.published import other_release

__all__ = ["weights"]


@click.group()
def weights() -> None:
    """Published weights into a training, trained adapters out of it.

    \b
    Example:
      forehoi weights import TRELLIS-image-large --config paper --out weights/trellis.safetensors
      forehoi weights merge runs/paper --out weights/paper.safetensors
    """


@weights.command("import")
@click.argument("source", type=click.Path(path_type=Path))
@click.option(
    "--config",
    "config_name",
    metavar="NAME|FILE",
    default="paper",
    show_default=True,
    help="Preset or YAML file whose networks the weights are for.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    default=Path("weights/trellis.safetensors"),
    show_default=True,
    help="Weight file to write; the list of all keys goes beside it, as .keys.json.",
)
@plain_errors
def import_weights(source: Path, config_name: str, out: Path) -> None:
    """Convert published TRELLIS weights of the configuration's stage.

    SOURCE is a folder of them, a model in the cache of the Hugging Face hub (models--microsoft--TRELLIS-image-large),
    the output folder of a training of TRELLIS, or one file (safetensors, also in several parts; .pt).

    The file that is written is what `vae.weights` and `stage_one.start.weights`, or `slat_vae.weights` and
    `slat_flow.start`, of a configuration name.

    \b
    Example:
      forehoi weights import TRELLIS-image-large --config paper --out weights/trellis.safetensors
      forehoi weights import TRELLIS-image-large --config paper_slat --out weights/slat.safetensors
    """
    report = import_networks(source, load_config(config_name).published_networks(), out)
    Console().print(_table(report))
    for note in report.notes:
        _say(note)
    for path in report.ignored:
        release = other_release(path.name)
        _say(f"of another release, {release}: {path}" if release else f"not of this stage: {path}")
    for name in report.absent:
        _say(f"not in {source}: {name}")
    _say(f"every key: {report.key_list}")
    _say(f"wrote {out} ({out.stat().st_size / 1e6:.1f} MB)")


@weights.command()
@click.argument("run", type=click.Path(path_type=Path, file_okay=False))
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), required=True, help="Weight file to write."
)
@plain_errors
def merge(run: Path, out: Path) -> None:
    """Merge the adapters of a run into the weights that it started from; everything else it trained comes along.

    RUN is of stage 1 or of stage 2.

    \b
    Example:
      forehoi weights merge runs/paper --out weights/paper.safetensors
    """
    start = merge_run(run, out)
    _say(f"wrote {out} ({out.stat().st_size / 1e6:.1f} MB)")
    _say(f"to start from it: start: {start}")


@weights.command("export-adapter")
@click.argument("run", type=click.Path(path_type=Path, file_okay=False))
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    help="Folder to write, as peft does.",
)
@plain_errors
def export(run: Path, out: Path) -> None:
    """Write the adapter of a run for the peft library: adapter_config.json and adapter_model.safetensors.

    It adapts the geometry branch, or the SLat flow, alone; what else was trained is in the run's checkpoint.

    \b
    Example:
      forehoi weights export-adapter runs/paper --out adapters/paper
    """
    parameters = export_run_adapter(run, out)
    _say(f"wrote {out} ({parameters:,} parameters)")


def _say(line: str) -> None:
    """Names of files may hold anything: brackets that are no markup, bytes that are no UTF-8."""
    click.echo(_printable(line))


def _printable(text: str) -> str:
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def _table(report: ImportReport) -> Table:
    table = Table(title="keys of the published files", title_justify="left")
    counts = ("used", "missing", "unused", "other shape", "new")
    for column in ("network", "file", *counts):
        table.add_column(column, justify="right" if column in counts else "left", overflow="fold")
    for file in report.imported:
        keys = file.keys
        numbers = (keys.used, keys.missing, keys.unused, keys.mismatched, file.new)
        name = Text(_printable(file.path.name))
        table.add_row(file.network, name, *[str(len(names)) for names in numbers])
    return table
