"""The progress bar of `datagen render`: frames done, frames per second, time left."""

from collections.abc import Sequence
from types import TracebackType

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from datagen.jobs.render_shard import ShardProgress
from datagen.plan.plan import MotionPlan

__all__ = ["RenderProgress"]

PHASE_TEXT = {
    "grasp": "finding a grasp for",
    "scene": "arranging",
    "render": "rendering",
    "annotate": "annotating",
    "pack": "packing",
}


class FrameRate(ProgressColumn):
    """Frames per second since the first frame of this run."""

    def render(self, task: Task) -> Text:
        return Text(f"{task.speed:.2f} frames/s" if task.speed else "- frames/s", style="progress.data.speed")


class RenderProgress:
    """A live bar on a terminal; one line per finished motion everywhere."""

    def __init__(self, motions: Sequence[MotionPlan]) -> None:
        self._motions = {motion.motion_index: motion for motion in motions}
        self._rendered = dict.fromkeys(self._motions, 0)
        console = Console(stderr=True)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            FrameRate(),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
            speed_estimate_period=120.0,
        )
        total = sum(self._n_frames(index) for index in self._motions)
        self._task = self._bar.add_task("starting", total=total)

    def __enter__(self) -> "RenderProgress":
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def update(self, step: ShardProgress) -> None:
        """Take one step of one motion."""
        motion = self._motions[step.motion_index]
        if step.phase in ("staged", "done", "skipped"):
            self._advance_to(step.motion_index, self._n_frames(step.motion_index))
            text = {
                "staged": "was finished before",
                "done": "done",
                "skipped": "skipped, reason in shard.json",
            }
            self._bar.console.print(f"motion {step.motion_index} ({motion.object_uid}): {text[step.phase]}")
            return
        if step.phase == "render":
            self._advance_to(step.motion_index, step.done)
        what = PHASE_TEXT.get(step.phase, step.phase)
        self._bar.update(self._task, description=f"{what} motion {step.motion_index} ({motion.object_uid})")

    def _n_frames(self, motion_index: int) -> int:
        motion = self._motions[motion_index]
        return motion.n_cameras * motion.n_frames

    def _advance_to(self, motion_index: int, done: int) -> None:
        self._bar.advance(self._task, done - self._rendered[motion_index])
        self._rendered[motion_index] = done
