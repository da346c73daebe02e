"""`forehoi reconstruct`: a video, images or a clip in; masks, voxels and a mesh out."""

from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from rich.text import Text

from model.cli.options import plain_errors
from model.errors import ModelError
from model.evaluation.surface import SurfaceScore, surface_score
from model.inference.clip_truth import clip_truth
from model.inference.held_out import held_out_clip
from model.inference.networks import StageOneRun, StageTwoRun, load_networks, open_stage_one, open_stage_two
from model.inference.reconstruction import STANDARD, Reconstruction, reconstruct
from model.inference.record import write_record
from model.inference.result_files import write_result
from model.inference.stage_clock import StageClock
from model.video.frame_choice import FrameChoice
from model.video.frames import ReadLimits, VideoFrames
from model.video.reading import read_frames, read_informative_frames
from model.video.square_crop import parsed_box
from model.video.staged_folder import staged_folder
from shards.printable import printable

__all__ = ["reconstruct_command"]

_CANDIDATES = ReadLimits(max_frames=64, max_side_px=512)  # among which frames are chosen
_METRIC_POINTS = 30_000  # on the mesh
_MAX_SIDE_PX = 2048  # of the frames that are used; larger ones are scaled down


@dataclass(frozen=True, kw_only=True)
class _Request:
    """What the command line asks for."""

    source: str | None  # None: a held-out clip
    frames: str | None
    count: int | None
    box: str | None
    seed: int
    device: torch.device
    one: StageOneRun
    two: StageTwoRun | None


@click.command("reconstruct")
@click.argument("source", metavar="INPUT", required=False)
@click.option(
    "--out", type=click.Path(path_type=Path), required=True, help="Folder for the results; a new one."
)
@click.option(
    "--stage-one",
    type=click.Path(path_type=Path),
    default=Path("runs/tiny"),
    show_default=True,
    help="Folder of a training of stage 1.",
)
@click.option(
    "--stage-two",
    type=click.Path(path_type=Path),
    default=Path("runs/tiny_slat"),
    show_default=True,
    help="Folder of a training of stage 2.",
)
@click.option(
    "--stages",
    type=click.Choice(["both", "one"]),
    default="both",
    show_default=True,
    help="'one' stops after masks and voxels: no mesh, no colours.",
)
@click.option("--frames", help="Frames to use, counted from 0, for example 0,5,9.  [default: chosen]")
@click.option(
    "--count",
    type=click.IntRange(min=1),
    help="Number of frames to choose.  [default: as stage 1 was validated with]",
)
@click.option(
    "--box", help="x0,y0,x1,y1 in pixels around hand and object in every frame.  [default: detected]"
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of the noise.")
@click.option("--held-out", is_flag=True, help="Take as INPUT a clip that the training of stage 1 never saw.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier result at --out.")
@click.option(
    "--device",
    default="auto",
    show_default=True,
    help="cpu, cuda, cuda:1, mps, or auto: a GPU if there is one.",
)
@plain_errors
def reconstruct_command(
    source: str | None,
    out: Path,
    stage_one: Path,
    stage_two: Path,
    stages: str,
    frames: str | None,
    count: int | None,
    box: str | None,
    seed: int,
    held_out: bool,
    overwrite: bool,
    device: str,
) -> None:
    """Reconstruct the object that a hand holds in INPUT.

    INPUT is a video (mp4, mov, ...), a folder of frames, one image, or a clip of a dataset (DATASET#CLIP_ID).
    Written are object.glb, voxels.ply, masks/ (the whole object, also where it is hidden), turntable.mp4,
    contact_sheet.png and reconstruction.json. Nothing is left behind when something fails.

    \b
    Example:
      forehoi reconstruct video.mp4 --out result
      forehoi reconstruct frames/ --out result --frames 0,5,9 --box 120,40,520,430
      forehoi reconstruct data/tiny#motion-000000-cam-03 --out result
    """
    if (source is None) != held_out:
        raise ModelError(
            "INPUT",
            "missing" if source is None else "given beside --held-out",
            expected="a video, a folder of images, or DATASET#CLIP_ID; or --held-out",
            action="See forehoi reconstruct --help.",
        )
    if frames is not None and count is not None:
        raise ModelError("--count", "given beside --frames", expected="one of them", action="Drop one.")
    with staged_folder(out, overwrite=overwrite) as folder:
        request = _Request(
            source=source,
            frames=frames,
            count=count,
            box=box,
            seed=seed,
            device=_device(device),
            one=open_stage_one(stage_one),
            two=open_stage_two(stage_two) if stages == "both" else None,
        )
        with Console(stderr=True).status("") as status:  # in a terminal
            clock = StageClock(status.update)
            result, score = _run(request, folder, clock)
    _print(result, score, out, clock)


def _run(request: _Request, folder: Path, clock: StageClock) -> tuple[Reconstruction, SurfaceScore | None]:
    """Reads, reconstructs, compares with the truth where a dataset has it, and writes."""
    with clock.stage("read frames"):
        frames, choice = _read(request)
        boxes = None if request.box is None else [parsed_box(request.box, f) for f in frames.frames]
    with clock.stage("load networks"):
        networks = load_networks(request.one, request.two, request.device)
    settings = replace(STANDARD, seed=request.seed)
    result = reconstruct(frames, networks, settings, boxes_px=boxes, clock=clock)
    with clock.stage("write images and meshes"):
        write_result(result, folder)
    truth, score = clip_truth(frames), None
    if truth is not None and result.surface is not None:
        score = surface_score(result.surface.mesh, truth, _METRIC_POINTS, np.random.default_rng(0))
    write_record(
        folder,
        result,
        networks,
        choice=choice,
        truth=truth,
        score=score,
        seconds=clock.seconds,
    )
    return result, score


def _read(request: _Request) -> tuple[VideoFrames, FrameChoice | None]:
    source = request.source or held_out_clip(request.one.config)
    if request.frames is not None:
        indices = _indices(request.frames)
        limits = ReadLimits(max_frames=len(indices), max_side_px=_MAX_SIDE_PX)
        return read_frames(source, limits, indices=indices), None
    count = request.count or request.one.config.validation.views
    return read_informative_frames(source, count, _CANDIDATES, max_side_px=_MAX_SIDE_PX)


def _indices(text: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError as error:
        raise ModelError(
            f"--frames {text}", "not a list of numbers", expected="0,5,9", action="Correct it."
        ) from error


def _device(name: str) -> torch.device:
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise ModelError(
            f"--device {name}",
            f"cannot be used ({reason})",
            expected="a device of this machine",
            action="Use auto.",
        ) from error
    return device


def _print(result: Reconstruction, score: SurfaceScore | None, out: Path, clock: StageClock) -> None:
    """Where to look, how long it took, how good it is, and what the user should know."""
    table = Table(title=Text(printable(result.frames.source)), title_justify="left", show_footer=True)
    table.add_column("stage", footer="together")
    table.add_column("seconds", justify="right", footer=f"{sum(clock.seconds.values()):.1f}")
    for name, seconds in clock.seconds.items():
        table.add_row(name, f"{seconds:.1f}")
    console = Console()
    console.print(table)
    for note in result.notes:
        console.print(f"note: {printable(note)}", soft_wrap=True, markup=False)  # names may hold brackets
    used = ", ".join(str(index) for index in result.frames.indices)
    console.print(f"frames {used}: {len(result.voxels)} voxels", soft_wrap=True)
    if result.surface is not None:
        report = result.surface.report
        console.print(
            f"mesh: {report.faces} faces, watertight, {report.components} component(s)", soft_wrap=True
        )
    if score is not None:
        console.print(
            f"against the clip's true surface, without alignment: chamfer {score.points.chamfer_cm:.2f} cm, "
            f"F-score {score.points.f_5mm:.1f} % at 5 mm, {score.points.f_10mm:.1f} % at 10 mm, normals off by "
            f"{score.normal_deg:.0f} degrees, colour error {score.color:.2f}",
            soft_wrap=True,
        )
    console.print(f"look at {out / 'contact_sheet.png'} and {out / 'turntable.mp4'}", soft_wrap=True)
