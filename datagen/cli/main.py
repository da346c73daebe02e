"""The `datagen` command: parse, call, print. Everything else lives in the modules it calls."""

import sys
from pathlib import Path

import click
from rich.console import Console

from datagen.cli.config_command import config_command
from datagen.cli.count_progress import CountProgress
from datagen.cli.input_commands import assets, grasps, select
from datagen.cli.options import (
    config_option,
    default_out,
    license_option,
    out_option,
    plain_errors,
    workers_option,
)
from datagen.cli.render_progress import RenderProgress
from datagen.config import load_config
from datagen.inspection.plan_table import plan_table
from datagen.inspection.selection_table import selection_lines
from datagen.inspection.sheet import contact_sheet, write_png
from datagen.inspection.summary import report_lines, shard_line, shard_summary
from datagen.inspection.video import write_video
from datagen.jobs.plan_dataset import plan_dataset
from datagen.jobs.render_shard import RenderOptions, render_shard
from datagen.jobs.select_motions import Selection
from shards.reader import Shard, open_shard
from shards.verify import verify_dataset
from shards.writer import shard_dir

__all__ = ["main"]


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="forehoi-open")
def main() -> None:
    """Make and check datasets of hands that hold objects.

    \b
    Example:
      datagen render --shard 0
      datagen inspect shard 0
    """


for command in (config_command, select, grasps, assets):
    main.add_command(command)


@main.command()
@config_option
@out_option
@license_option
@workers_option
@plain_errors
def plan(config_name: str, out: Path | None, licence_allow: tuple[str, ...] | None, workers: int) -> None:
    """Decide what to render: write dataset.json, selection.parquet and plan.parquet.

    \b
    Example:
      datagen plan --config paper --out data/paper
    """
    config = load_config(config_name, licence_allow=licence_allow)
    out = out or default_out(config_name)
    with CountProgress("looking at objects") as bar:
        made, selection = plan_dataset(config, out, workers=workers, report=bar.update)
    _say_selection(selection)
    Console().print(plan_table(made, out))


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
@click.option(
    "--workers", type=click.IntRange(min=1), default=1, show_default=True, help="Motions at a time."
)
@click.option("--threads", type=click.IntRange(min=1), default=None, help="Render threads of each worker.")
@license_option
@plain_errors
def render(
    config_name: str,
    out: Path | None,
    shard: int,
    device: str,
    workers: int,
    threads: int | None,
    licence_allow: tuple[str, ...] | None,
) -> None:
    """Render one shard, or what is missing of it, and verify it.

    \b
    Example:
      datagen render --config tiny --shard 0
    """
    config = load_config(config_name, licence_allow=licence_allow)
    out = out or default_out(config_name)
    with CountProgress("looking at objects") as bar:
        made, selection = plan_dataset(config, out, workers=workers, report=bar.update)
    _say_selection(selection)
    options = RenderOptions(
        device=device, workers=workers, threads_per_worker=threads, licence_allow=licence_allow
    )
    with RenderProgress(made.shard(shard)) as progress:
        record = render_shard(config_name, config, made, out, shard, options, progress.update)
    click.echo(shard_line(record, out))
    click.echo(f"look at it: datagen inspect shard {shard} --out {out} --sheet sheet.png")


@main.group()
def inspect() -> None:
    """Look at what was rendered.

    \b
    Example:
      datagen inspect shard 0 --sheet sheet.png
    """


@inspect.command("shard")
@click.argument("shard")
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("data/tiny"),
    show_default=True,
    help="Dataset folder, when the shard is given by its number.",
)
@click.option("--sheet", type=click.Path(path_type=Path, dir_okay=False), help="Write a contact sheet (PNG).")
@click.option("--clips", type=click.IntRange(min=1), default=8, show_default=True, help="Clips on the sheet.")
@click.option(
    "--frames", type=click.IntRange(min=1), default=6, show_default=True, help="Moments of each clip."
)
@click.option(
    "--tile", type=click.IntRange(min=64), default=256, show_default=True, help="Tile width in pixels."
)
@click.option("--video", type=click.Path(path_type=Path, dir_okay=False), help="Write one clip as MP4.")
@click.option("--clip", "clip_id", default=None, help="Clip of the video.  [default: the first]")
@plain_errors
def inspect_shard(
    shard: str,
    out: Path,
    sheet: Path | None,
    clips: int,
    frames: int,
    tile: int,
    video: Path | None,
    clip_id: str | None,
) -> None:
    """Print what SHARD (a number, or a path) holds; draw it with its labels.

    \b
    Example:
      datagen inspect shard 0 --sheet sheet.png --video clip.mp4
    """
    opened = _open(shard, out)
    console = Console()
    console.print(shard_summary(opened))
    if sheet is not None:
        write_png(sheet, contact_sheet(opened, n_clips=clips, n_frames=frames, tile_px=tile))
        console.print(f"contact sheet: {sheet}")
    if video is not None:
        write_video(opened, clip_id or opened.record.clip_ids[0], video, repeats=4)
        console.print(f"video: {video}")


@main.command()
@click.argument("path", type=click.Path(path_type=Path))
@plain_errors
def verify(path: Path) -> None:
    """Check every byte and every number of a dataset or of one shard; exit status 1 when something is wrong.

    \b
    Example:
      datagen verify data/tiny
    """
    bad = 0
    with CountProgress("verifying") as bar:
        reports = verify_dataset(
            path, progress=lambda shard, done, total: bar.update(done, total, f"verifying shard {shard}")
        )
        for report in reports:
            for line in report_lines(report):
                bar.print(line)
            bad += not report.ok
    sys.exit(1 if bad else 0)


def _say_selection(selection: Selection | None) -> None:
    """One line on a selection that was made just now; nothing on a plan that was there."""
    if selection is not None:
        for line in selection_lines(selection):
            click.echo(line)


def _open(shard: str, out: Path) -> Shard:
    return open_shard(shard_dir(out, int(shard)) if shard.isdecimal() else shard)
