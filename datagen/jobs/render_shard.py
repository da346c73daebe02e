"""One shard, from plan to verified files: skip what is staged, render the rest, commit.

Motions are independent, so they run in as many worker processes as asked for; the result
does not depend on their number or order. A run that was killed is continued by running it
again.
"""

import fcntl
import os
import shutil
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from datagen.config import DatasetConfig, provenance_of
from datagen.plan.plan import MotionPlan, Plan
from datagen.plan.selection_rules import read_takedown, taken_down
from datagen.processes.child_process import BAD_INPUT, ChildError, Event, run_child
from shards.storage.records import Provenance, ShardRecord
from shards.writer import (
    commit_shard,
    is_motion_staged,
    is_shard_committed,
    motion_dir,
    shard_dir,
    stage_skipped_motion,
    staging_dir,
)

__all__ = ["PipelineError", "RenderOptions", "ShardProgress", "render_shard"]


class PipelineError(RuntimeError):
    """A shard could not be finished; what is staged stays and is used by the next run."""


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """How this machine does the work; nothing here changes the data."""

    device: str  # auto, cpu, cuda, optix, hip, metal
    workers: int
    threads_per_worker: int | None  # None: the cores divided by the workers
    licence_allow: tuple[str, ...] | None = None  # as in load_config; the workers load the file themselves


@dataclass(frozen=True, kw_only=True)
class ShardProgress:
    """One step of one motion."""

    motion_index: int
    phase: str  # staged, grasp, scene, render, annotate, done, skipped
    done: int
    total: int


def render_shard(
    config_name: str | Path,
    config: DatasetConfig,
    plan: Plan,
    out: Path,
    shard: int,
    options: RenderOptions,
    report: Callable[[ShardProgress], None],
) -> ShardRecord:
    """Render what is missing of one shard and commit it. Safe to repeat, kill and repeat.

    What has come onto the takedown list since the plan was made is skipped with that reason, also
    where it waits rendered; of a shard that is finished it raises PipelineError.
    """
    motions = plan.shard(shard)
    indices = [motion.motion_index for motion in motions]
    provenance = provenance_of(config)
    with _lock(staging_dir(out, shard).with_suffix(".lock")):
        _take_down(motions, out, shard, read_takedown(config.selection.takedown), provenance)
        if not is_shard_committed(out, shard):
            staged = [index for index in indices if is_motion_staged(out, shard, index, provenance)]
            for index in staged:
                report(ShardProgress(motion_index=index, phase="staged", done=1, total=1))
            waiting = [index for index in indices if index not in staged]
            _run_workers(config_name, out, waiting, shard, options, report)
        return commit_shard(out, shard, motion_indices=indices, provenance=provenance)


def _take_down(
    motions: Sequence[MotionPlan], out: Path, shard: int, takedown: frozenset[str], provenance: Provenance
) -> None:
    listed = {motion: taken_down(motion.object_uid, motion.sequence_id, takedown) for motion in motions}
    named = {motion: entry for motion, entry in listed.items() if entry is not None}
    if named and is_shard_committed(out, shard):
        entries = ", ".join(sorted(set(named.values())))
        raise PipelineError(
            f"{shard_dir(out, shard)}: is finished and holds {len(named)} motions of what the takedown list "
            f"names ({entries}); delete this shard, withdraw its copies, and render it again"
        )
    for motion, entry in named.items():
        shutil.rmtree(motion_dir(out, shard, motion.motion_index), ignore_errors=True)
        stage_skipped_motion(
            out,
            shard,
            motion.motion_index,
            reason=f"on the takedown list as {entry}",
            timings_s={},
            provenance=provenance,
        )


def _run_workers(
    config_name: str | Path,
    out: Path,
    motion_indices: list[int],
    shard: int,
    options: RenderOptions,
    report: Callable[[ShardProgress], None],
) -> None:
    threads = options.threads_per_worker or max(1, (os.cpu_count() or 1) // options.workers)
    report_lock = threading.Lock()

    def render(motion_index: int) -> ChildError | None:
        def on_event(event: Event) -> None:
            with report_lock:
                report(ShardProgress(motion_index=motion_index, **event))

        command = [
            sys.executable,
            "-m",
            "datagen.jobs.render_motion",
            "--config",
            str(config_name),
            "--out",
            str(out),
        ]
        command += ["--motion", str(motion_index), "--device", options.device, "--threads", str(threads)]
        if options.licence_allow is not None:
            command += ["--license-allow", ",".join(options.licence_allow)]
        try:
            run_child(
                command,
                log=motion_dir(out, shard, motion_index).with_suffix(".log"),
                on_event=on_event,
                is_last=lambda event: event["phase"] in ("done", "skipped"),
                # BLAS threads would only fight with Cycles, and one thread sums in one order everywhere.
                env={"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            )
        except ChildError as error:
            return error
        return None

    with ThreadPoolExecutor(max_workers=options.workers) as pool:
        errors = [error for error in pool.map(render, motion_indices) if error is not None]
    if errors:
        bugs = [error for error in errors if error.status != BAD_INPUT]
        lines = "\n".join(str(error) for error in bugs or errors)
        failed = f"{len(errors)} of {len(motion_indices)} motions"
        raise PipelineError(f"shard {shard}: {failed} failed, the others are staged and kept: {lines}")


@contextmanager
def _lock(path: Path) -> Iterator[None]:
    """Two runs on one shard would stage over each other; the lock ends with the process."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise PipelineError(
                f"{path}: another process is rendering this shard; wait for it or stop it"
            ) from error
        yield
