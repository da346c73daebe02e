"""Commands about what goes in: `datagen assets`, `datagen select`, `datagen grasps`."""

import difflib
import time
from collections.abc import Mapping
from pathlib import Path

import click
import numpy as np
from rich.console import Console

from datagen.cli.count_progress import CountProgress
from datagen.cli.options import (
    config_option,
    default_out,
    license_option,
    out_option,
    plain_errors,
    workers_option,
)
from datagen.config import DatasetConfig, load_config
from datagen.grasps.recorded.graspxl import SequenceFile, read_sequence
from datagen.grasps.recorded.replay import ReplayError, replay
from datagen.grasps.recorded.replay_report import ReplayOutcome
from datagen.grasps.synthesis.report import GraspReport, summarise
from datagen.grasps.synthesis.synthesise import GraspAttemptReport, synthesise_grasp
from datagen.hands.model import ShapedHand, shape_hand
from datagen.input_error import InputError
from datagen.inspection.grasp_table import grasp_table
from datagen.inspection.inventory import asset_states
from datagen.inspection.inventory_table import asset_lines
from datagen.inspection.replay_table import replay_table
from datagen.inspection.selection_table import selection_lines, selection_table
from datagen.jobs.select_motions import select_motions
from datagen.objects.asset.object_asset import ObjectAsset
from datagen.objects.errors import ObjectError
from datagen.plan.plan import SELECTION_FILE
from datagen.plan.selection_rules import names_of, normalised_name
from datagen.sampling.streams import Stream, stream_rng
from datagen.sources.hands import open_hand
from datagen.sources.motions import recorded_sequences
from datagen.sources.objects import open_library

__all__ = ["assets", "grasps", "select"]


@click.command()
@config_option
@plain_errors
def assets(config_name: str) -> None:
    """List every open and licensed input: whether it is there, its version and licence, how to get it.

    \b
    Example:
      datagen assets --config graspxl
    """
    console = Console()
    console.print(asset_lines(asset_states(load_config(config_name)), console.width), soft_wrap=True)


@click.command()
@config_option
@out_option
@license_option
@workers_option
@plain_errors
def select(config_name: str, out: Path | None, licence_allow: tuple[str, ...] | None, workers: int) -> None:
    """Decide which motions are worth rendering; print how many each rule removes, write the reasons.

    \b
    Example:
      datagen select --config small --license-allow cc0,by
    """
    config = load_config(config_name, licence_allow=licence_allow)
    out = out or default_out(config_name)
    with CountProgress("looking at objects") as bar:
        selection = select_motions(config, out, workers=workers, report=bar.update)
    console = Console()
    console.print(selection_table(selection.decisions))
    for line in selection_lines(selection):
        click.echo(line)
    click.echo(f"every decision with its reason and metrics: {out / SELECTION_FILE}")


@click.command()
@config_option
@click.option(
    "--object", "objects", multiple=True, help="Only this object (may be repeated).  [default: all]"
)
@click.option(
    "--motions",
    type=click.IntRange(min=1),
    default=None,
    help="Motions per object.  [default: 1 simulated, or all recorded]",
)
@plain_errors
def grasps(config_name: str, objects: tuple[str, ...], motions: int | None) -> None:
    """Simulate or replay grasps without rendering; print success, contact distances and quality.

    \b
    Example:
      datagen grasps --object starter/milk --motions 3
    """
    config = load_config(config_name)
    with CountProgress("grasping") as bar:
        if config.motions.source == "simulated":
            table = grasp_table(_simulated(config, objects, motions or 1, bar))
        else:
            table = replay_table(_replayed(config, objects, motions, bar))
    Console().print(table)


def _simulated(
    config: DatasetConfig, objects: tuple[str, ...], motions: int, bar: CountProgress
) -> GraspReport:
    library = open_library(config.objects, config.motions)
    uids = objects or tuple(uid for uid in library.uids() if uid not in config.objects.exclude)
    hand = shape_hand(open_hand(config.hand).right, np.zeros(config.sampling.appearance.n_betas))
    reports: list[GraspAttemptReport] = []
    for number, uid in enumerate(uids):
        asset = library.load(uid)
        for motion in range(motions):
            bar.update(len(reports), len(uids) * motions, uid)
            rng = stream_rng(config.seed, number, Stream.GRASP, 1 + motion)
            reports.append(synthesise_grasp(hand, asset, config.grasp, rng))
    return summarise(reports)


def _replayed(
    config: DatasetConfig, objects: tuple[str, ...], motions: int | None, bar: CountProgress
) -> list[ReplayOutcome]:
    of_object: dict[str, list[SequenceFile]] = {}
    for file in recorded_sequences(config.motions).values():
        of_object.setdefault(file.object_uid, []).append(file)
    wanted = {name: uids_named(name, of_object) for name in objects}
    chosen = [uid for uids in wanted.values() for uid in uids] or list(of_object)
    library = open_library(config.objects, config.motions)
    model = open_hand(config.hand).right
    hand = shape_hand(model, np.zeros(model.shapedirs.shape[2]))
    outcomes: list[ReplayOutcome] = []
    for done, uid in enumerate(chosen):
        bar.update(done, len(chosen), uid)
        files = of_object[uid][:motions]
        try:
            asset = library.load(uid)
        except ObjectError as error:
            outcomes += [ReplayOutcome.refused(file.sequence_id, str(error)) for file in files]
            continue
        outcomes += [_replay_one(file, hand, asset, config) for file in files]
    return outcomes


def uids_named(name: str, of_object: Mapping[str, object]) -> list[str]:
    """Objects that a name given on the command line means: the uid, or all sizes of an object."""
    found = [uid for uid in of_object if normalised_name(name) in names_of(uid)]
    if not found:
        close = difflib.get_close_matches(name, of_object, n=1)
        raise InputError(
            "--object",
            f"{name!r} has no recorded motion",
            expected="an object of the GraspXL folder",
            action=f"Did you mean {close[0]!r}?" if close else "`datagen select` lists them.",
        )
    return found


def _replay_one(
    file: SequenceFile, hand: ShapedHand, asset: ObjectAsset, config: DatasetConfig
) -> ReplayOutcome:
    began = time.process_time()
    try:
        sequence = replay(read_sequence(file), hand, asset, config.motions.replay)
    except (ReplayError, InputError) as error:
        return ReplayOutcome.refused(file.sequence_id, str(error))
    return ReplayOutcome(
        sequence_id=file.sequence_id,
        sequence=sequence,
        reason="",
        cpu_seconds=time.process_time() - began,
    )
