"""One motion from grasp to staged rows, in one process: `python -m datagen.jobs.render_motion`.

Everything here is a pure function of configuration and motion index; device and thread
count change nothing but the time (and the last bits of a colour).
"""

import argparse
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np

from datagen.annotation.annotate import MotionGeometry, annotate_frame, hand_object_distances
from datagen.annotation.rows import RenderRecord, clip_row, encoded_rgb, frame_row, object_row
from datagen.config import DatasetConfig, load_config, provenance_of
from datagen.grasps.recorded.replay import ReplayError
from datagen.hands.model import shape_hand
from datagen.input_error import InputError
from datagen.jobs.planned_motion import NoGraspError, UnusableObjectError, drawn_sequence, load_object
from datagen.objects.asset.object_asset import ObjectAsset
from datagen.objects.targets.learning_targets import learning_targets
from datagen.plan.plan import PLAN_FILE, MotionPlan, read_plan
from datagen.processes.child_process import BAD_INPUT, ChildError, Event, die_with_parent, emit, run_child
from datagen.processes.phase_timer import PhaseTimer
from datagen.sampling.errors import SamplingError
from datagen.sampling.frustum import require_frustum
from datagen.sampling.scene_sampling import SampledMotion, sample_scene
from datagen.scene.frame_files import frame_path
from datagen.scene.scene_file import save_scene
from datagen.sources.hands import open_hand
from shards.errors import ShardError
from shards.schema import ClipRow, FrameRow
from shards.storage.records import Provenance
from shards.writer import motion_dir, stage_motion, stage_skipped_motion

__all__ = ["RENDERER", "Job", "main", "run_job", "sampled_motion"]

RENDERER = (sys.executable, "-m", "datagen.blender")  # a process of its own; see datagen/blender/README.md


@dataclass(frozen=True, kw_only=True)
class Job:
    """What one worker process is asked to do."""

    config: DatasetConfig
    motion: MotionPlan
    out: Path
    device: str
    threads: int

    @property
    def work_dir(self) -> Path:
        """Where images wait for their labels; what is there after a kill is used again."""
        return motion_dir(self.out, self.motion.shard, self.motion.motion_index).with_suffix(".work")

    @property
    def provenance(self) -> Provenance:
        return provenance_of(self.config)


def main(arguments: list[str] | None = None) -> None:
    """Render and stage one motion; progress as JSON lines on standard output."""
    parser = argparse.ArgumentParser(prog="python -m datagen.jobs.render_motion", description=main.__doc__)
    parser.add_argument("--config", required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--motion", type=int, required=True)
    parser.add_argument("--device", required=True)
    parser.add_argument("--threads", type=int, required=True)
    parser.add_argument("--license-allow", type=lambda text: tuple(text.split(",")))
    options = parser.parse_args(arguments)
    die_with_parent()
    try:
        job = Job(
            config=load_config(options.config, licence_allow=options.license_allow),
            motion=read_plan(options.out / PLAN_FILE).motions[options.motion],
            out=options.out,
            device=options.device,
            threads=options.threads,
        )
        run_job(job)
    except (InputError, ShardError) as error:
        _refuse(error)
    except ChildError as error:
        if error.status != BAD_INPUT:
            raise
        _refuse(error)


def _refuse(error: Exception) -> NoReturn:
    """What a user can cause ends as one line; anything else is a bug and keeps its trace."""
    sys.stderr.write(f"{error}\n")
    sys.exit(BAD_INPUT)


def run_job(job: Job) -> None:
    """Grasp, scene, images, annotations, rows. What cannot be made is staged as skipped, with the reason."""
    timer = PhaseTimer()
    shard, index = job.motion.shard, job.motion.motion_index
    emit(phase="grasp", done=0, total=1)
    try:
        with timer.phase("object"):
            asset = load_object(job.config, job.motion)
        sampled = sampled_motion(job, asset, timer)
    except (UnusableObjectError, NoGraspError, ReplayError, SamplingError) as error:
        provenance, seconds = job.provenance, timer.seconds
        stage_skipped_motion(
            job.out, shard, index, reason=str(error), timings_s=seconds, provenance=provenance
        )
        emit(phase="skipped", done=1, total=1)
        return
    record = _rendered(job, sampled, timer)
    with timer.phase("targets"):
        targets = learning_targets(asset, job.config.seed, job.config.targets)
    clips, frames = _rows(job, sampled, record, timer)
    stage_motion(
        job.out,
        shard,
        index,
        object_row=object_row(asset, targets),
        clips=clips,
        frames=frames,
        timings_s=timer.seconds,
        provenance=job.provenance,
    )
    shutil.rmtree(job.work_dir)
    emit(phase="done", done=1, total=1)


def sampled_motion(job: Job, asset: ObjectAsset, timer: PhaseTimer) -> SampledMotion:
    """Grasp and scene of one motion, each draw from its own stream of this motion's seed."""
    with timer.phase("grasp"):
        hand = open_hand(job.config.hand)
        sequence = drawn_sequence(job.config, job.motion, hand.right, asset)
    emit(phase="scene", done=0, total=1)
    with timer.phase("scene"):
        sampled = sample_scene(
            sequence,
            shape_hand(hand.model(sequence.side), sequence.betas),
            hand.skins,
            asset,
            job.config.sampling,
            dataset_seed=job.config.seed,
            motion_index=job.motion.motion_index,
            motion_id=job.motion.motion_id,
        )
    with timer.phase("frustum"):
        require_frustum(sampled, job.config.sampling.cameras)
    return sampled


def _rendered(job: Job, sampled: SampledMotion, timer: PhaseTimer) -> RenderRecord:
    """Let Blender render what is missing of this motion's images."""
    job.work_dir.mkdir(parents=True, exist_ok=True)
    scene_path = job.work_dir / "scene.npz"
    save_scene(sampled.scene, scene_path)
    n_frames, n_cameras = len(sampled.scene.T_world_from_obj), len(sampled.scene.cameras)
    camera_seconds = np.zeros(n_cameras)
    done = 0

    def on_event(event: Event) -> None:
        nonlocal done
        if event["event"] == "frame":
            done += 1
            camera_seconds[event["camera"]] += sum(event["seconds"].values())
            emit(phase="render", done=done, total=n_cameras * n_frames)

    command = [*RENDERER, "--scene", str(scene_path), "--frames-dir", str(job.work_dir)]
    command += ["--device", job.device, "--threads", str(job.threads)]
    with timer.phase("blender"):
        summary = run_child(
            command,
            log=job.work_dir / "blender.log",
            on_event=on_event,
            is_last=lambda event: event["event"] == "done",
        )
    for phase, seconds in summary["seconds"].items():
        timer.add(f"blender.{phase}", seconds)
    return RenderRecord(
        engine_version=f"bpy {summary['bpy_version']}",
        device=", ".join((summary["device"], *summary["device_names"])),
        denoiser="OpenImageDenoise" if sampled.scene.render.denoise else "none",
        seconds_per_camera=tuple(camera_seconds.tolist()),
    )


def _rows(
    job: Job, sampled: SampledMotion, record: RenderRecord, timer: PhaseTimer
) -> tuple[list[ClipRow], list[FrameRow]]:
    """Annotate every image and encode it; rows run camera by camera, frame by frame."""
    n_frames, n_cameras = len(sampled.scene.T_world_from_obj), len(sampled.scene.cameras)
    geometry = MotionGeometry(sampled.scene)
    distances_m = hand_object_distances(sampled.scene)
    rows: list[list[FrameRow]] = [[] for _ in range(n_cameras)]
    for frame in range(n_frames):
        with timer.phase("annotate"):
            annotated = annotate_frame(geometry, frame)
        with timer.phase("pack"):
            for camera, buffers in enumerate(annotated):
                png = frame_path(job.work_dir, camera, frame).read_bytes()
                rgb = encoded_rgb(png, job.config.shard)
                rows[camera].append(
                    frame_row(
                        job.motion, sampled, camera, frame, buffers, distances_m[frame], rgb, job.config.shard
                    )
                )
        emit(phase="annotate", done=(frame + 1) * n_cameras, total=n_frames * n_cameras)
    clips = [
        clip_row(job.motion, sampled, camera, rows[camera], record, job.config.shard, job.config.seed)
        for camera in range(n_cameras)
    ]
    return clips, [row for camera_rows in rows for row in camera_rows]


if __name__ == "__main__":
    main()
