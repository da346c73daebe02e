"""Which part of a motion is drawn, and at what rate."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int

from datagen.grasps.sequence import GraspSequence
from datagen.sampling.errors import SamplingError
from shards.settings import Range

__all__ = ["ClipConfig", "ClipWindow", "clip_windows", "object_movement"]

CANDIDATES, PICKUPS = 24, 5
METRES_PER_RADIAN = 0.3  # travel that counts as much as one radian of turning


@dataclass(frozen=True, kw_only=True)
class ClipConfig:
    """Length and rate of the clips of a motion."""

    n_frames: Annotated[int, Range(1, 10_000)]
    # one is drawn per motion, among those the motion is long enough for
    fps: Annotated[tuple[float, ...], Range(0.1, 1000)]
    # of a clip that begins while the object still lies on a table
    pickup_probability: Annotated[float, Range(0, 1)]
    before_grasp_s: Annotated[float, Range(0, 60)]  # how much of the approach may be seen then
    # 0: any part of the motion; larger: parts in which the object moves most
    preference: Annotated[float, Range(0, 1000)]


@dataclass(frozen=True, kw_only=True)
class ClipWindow:
    """Frames of the sequence that are drawn."""

    frames: Int[np.ndarray, " frame"]  # indices into the sequence
    fps: float
    supported: bool  # the object lies on a table in at least one drawn frame
    movement_rad: float  # `object_movement`

    def first_grasped(self, sequence: GraspSequence) -> int:
        """First drawn frame in which the hand carries the object."""
        return int(np.searchsorted(self.frames, sequence.grasp_frame))


def clip_windows(
    sequence: GraspSequence, config: ClipConfig, rng: np.random.Generator
) -> Iterator[ClipWindow]:
    """Windows in random order, those in which the object moves more coming sooner.

    Frames are the simulated ones nearest to the clip's times, so that contacts are as simulated.
    A window that begins before the grasp needs a table under the object; with `pickup_probability`
    these come first, otherwise last. When no window at the drawn rate works, faster and slower ones
    follow. Sequences that begin in mid-air are drawn from the grasp on. Raises SamplingError when
    the motion is too short.
    """
    wants_pickup = rng.uniform() < config.pickup_probability
    first = max(
        0, sequence.first_drawn_frame, sequence.grasp_frame - round(config.before_grasp_s * sequence.fps)
    )
    if sequence.start == "held":
        first = max(first, sequence.grasp_frame)
    n_frames = len(sequence.T_world_from_obj)
    fitting = [fps for fps in config.fps if first + _span(sequence, config, fps) < n_frames]
    if not fitting:
        raise SamplingError(
            f"motion {sequence.sequence_id}: {n_frames - first} frames at {sequence.fps} fps from "
            f"frame {first} are too few for clips of {config.n_frames} frames at {config.fps} fps; "
            "raise clip.fps or lower clip.n_frames"
        )
    drawn = fitting[rng.integers(len(fitting))]
    others = sorted((fps for fps in fitting if fps != drawn), reverse=True)
    for fps in (drawn, *others):
        yield from _windows_at(fps, first, wants_pickup, sequence, config, rng)


def _windows_at(
    fps: float,
    first: int,
    wants_pickup: bool,
    sequence: GraspSequence,
    config: ClipConfig,
    rng: np.random.Generator,
) -> Iterator[ClipWindow]:
    """Windows of one rate that begin at frame `first` or later, in random order."""
    n_frames = len(sequence.T_world_from_obj)
    offsets = np.round(np.arange(config.n_frames) * sequence.fps / fps).astype(int)
    last = n_frames - 1 - offsets[-1]
    starts = np.unique(np.linspace(first, last, CANDIDATES).astype(int))
    if first < sequence.grasp_frame <= last:
        starts = np.union1d(starts, np.linspace(first, sequence.grasp_frame, PICKUPS).astype(int))
    movement = np.array([object_movement(sequence.T_world_from_obj[start + offsets]) for start in starts])
    # Gumbel noise on log weights: a random order without replacement.
    keys = config.preference * np.log(np.maximum(movement, 1e-3)) + rng.gumbel(size=len(starts))
    supported = starts < sequence.grasp_frame
    for index in np.lexsort((-keys, supported != wants_pickup)):
        start = int(starts[index])
        yield ClipWindow(
            frames=start + offsets,
            fps=fps,
            supported=bool(supported[index]),
            movement_rad=float(movement[index]),
        )


def object_movement(T_world_from_obj: Float[np.ndarray, "frame 4 4"]) -> float:
    """Largest turn from the first frame (radians) plus largest travel in units of 0.3 m."""
    R = T_world_from_obj[:, :3, :3]
    cosine = 0.5 * (np.einsum("tij,ij->t", R, R[0]) - 1.0)
    travel = np.linalg.norm(T_world_from_obj[:, :3, 3] - T_world_from_obj[0, :3, 3], axis=-1)
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)).max() + travel.max() / METRES_PER_RADIAN)


def _span(sequence: GraspSequence, config: ClipConfig, fps: float) -> int:
    return round((config.n_frames - 1) * sequence.fps / fps)
