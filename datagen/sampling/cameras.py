"""Cameras of one motion: candidates are framed exactly, then kept for what they see of the object."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Literal, get_args

import numpy as np
from jaxtyping import Float

from datagen.sampling.errors import SamplingError
from datagen.sampling.framing import Framing, Subject, frame_subject, image_drift_px, image_margin_px
from datagen.sampling.trajectories import MotionLimits, PathStyle, sample_view_path
from datagen.sampling.visibility import VisibilityProbe
from datagen.scene.scene import CameraPath
from shards.geometry import camera_center
from shards.settings import Range

__all__ = ["CameraMetrics", "CamerasConfig", "PathStyles", "Surroundings", "sample_cameras"]

CameraKind = Literal["orbit", "arc", "handheld", "dolly", "egocentric"]
KINDS: tuple[CameraKind, ...] = get_args(CameraKind)
EGOCENTRIC_SPREAD_RAD = np.radians(40.0)  # of the head's azimuth about the forearm's


@dataclass(frozen=True, kw_only=True)
class PathStyles:
    """The five kinds of camera path."""

    orbit: PathStyle
    arc: PathStyle
    handheld: PathStyle
    dolly: PathStyle
    egocentric: PathStyle

    def __post_init__(self) -> None:
        if sum(getattr(self, field.name).weight for field in fields(self)) <= 0.0:
            raise ValueError("all camera kinds have weight 0: expected a positive weight for at least one")


@dataclass(frozen=True, kw_only=True)
class CamerasConfig:
    """Cameras of a motion. Lengths that are fractions refer to the image's shorter side."""

    n_cameras: Annotated[int, Range(1, 1000)]
    image_size: Annotated[tuple[int, int], Range(16, 8192)]  # (width, height) in pixels
    margin: Annotated[float, Range(0, 0.45)]  # fraction kept free at every border
    near_m: Annotated[float, Range(0.001, 10)]  # no hand or object vertex nearer
    # distance over the one that just frames the subject, >= 1
    slack: Annotated[tuple[float, float], Range(1, 10, rising=True)]
    max_drift: Annotated[float, Range(0, 1)]  # fraction; of the object's centre from its mean place
    smoothing_s: Annotated[float, Range(0, 60)]
    limits: MotionLimits
    styles: PathStyles
    # without a table (egocentric keeps its own)
    free_elevation_deg: Annotated[tuple[float, float], Range(-90, 90, rising=True)]
    table_clearance_m: Annotated[float, Range(0, 10)]  # cameras stay so far above the plane of the table
    arm_clearance_m: Annotated[float, Range(0, 10)]
    min_visible: Annotated[float, Range(0, 1)]  # visible fraction of the object, worst frame
    min_visible_mean: Annotated[float, Range(0, 1)]
    min_object_size: Annotated[float, Range(0, 1)]  # fraction; square root of the object's area, worst frame
    attempts: Annotated[int, Range(1, 100_000)]  # candidates per camera
    # so many of them may be refused for showing where the drawn arm ends
    arm_end_attempts: Annotated[int, Range(0, 100_000)]
    probe_rays: Annotated[int, Range(4, 4096)]  # rays across the image

    def __post_init__(self) -> None:
        if self.slack[0] < 1.0:
            raise ValueError(
                f"slack starts at {self.slack[0]}: expected >= 1, or vertices would leave the image"
            )
        if not 0.0 <= self.margin < 0.4:
            raise ValueError(f"margin is {self.margin}: expected 0 <= margin < 0.4 of the shorter side")


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """What cameras must stay clear of. World, metres."""

    arm_verts_world: Float[np.ndarray, "frame arm_vert 3"]
    forearm_direction_world: Float[np.ndarray, "3"]  # unit, from the wrist to the elbow
    table_top_z_m: float | None


@dataclass(frozen=True, kw_only=True)
class CameraMetrics:
    """What was measured of one camera over all frames; visibility by coarse rays."""

    kind: CameraKind
    attempts: int
    fov_rad: float
    object_drift_px: float
    min_margin_px: float
    visible_fraction_min: float
    visible_fraction_mean: float
    object_size_px: float  # worst frame
    arm_end_seen: bool  # the end of the drawn arm is in the image in some frame
    distance_m: tuple[float, float]  # camera to object centre: least, greatest
    clearance_m: float  # to the arm and, with a table, to its plane

    def objections(self, config: CamerasConfig) -> list[str]:
        """Why this candidate cannot be kept; empty when it can."""
        size = self.object_size_px / min(config.image_size)
        checks = [
            ("visible fraction (worst)", self.visible_fraction_min, config.min_visible),
            ("visible fraction (mean)", self.visible_fraction_mean, config.min_visible_mean),
            ("object size / image", size, config.min_object_size),
            ("clearance in m over the least", self.clearance_m, 0.0),
        ]
        return [f"{name} {value:.3f} < {least:.3f}" for name, value, least in checks if value < least]


def sample_cameras(
    config: CamerasConfig,
    subject: Subject,
    probe: VisibilityProbe,
    around: Surroundings,
    rngs: Sequence[np.random.Generator],
) -> tuple[tuple[CameraPath, ...], tuple[CameraMetrics, ...]]:
    """One camera per generator: the first acceptable of `config.attempts` candidates each.

    Among the first `config.arm_end_attempts` one that does not show the end of the arm is preferred.
    Azimuths are spread around the subject. Raises SamplingError, with the metrics of the best
    candidate, when a camera finds none.
    """
    start = rngs[0].uniform(0.0, 2.0 * np.pi)
    found = [
        _sample_camera(config, subject, probe, around, rng, start + 2.0 * np.pi * index / len(rngs), index)
        for index, rng in enumerate(rngs)
    ]
    return tuple(path for path, _ in found), tuple(metrics for _, metrics in found)


def _sample_camera(
    config: CamerasConfig,
    subject: Subject,
    probe: VisibilityProbe,
    around: Surroundings,
    rng: np.random.Generator,
    azimuth_rad: float,
    index: int,
) -> tuple[CameraPath, CameraMetrics]:
    weights = np.array([getattr(config.styles, kind).weight for kind in KINDS])
    spread = np.pi / config.n_cameras
    kind = KINDS[0]
    best: CameraMetrics | None = None
    second_choice: tuple[CameraPath, CameraMetrics] | None = None
    for attempt in range(1, config.attempts + 1):
        # A kind that cannot see this grasp gives way to the others after half the attempts.
        if attempt == 1 or 2 * attempt > config.attempts:
            kind = KINDS[rng.choice(len(KINDS), p=weights / weights.sum())]
        near_azimuth = azimuth_rad + rng.uniform(-1.0, 1.0) * min(spread * attempt, np.pi)
        path = _candidate(config, subject, around, rng, kind, near_azimuth)
        metrics = _measure(config, subject, probe, around, path, attempt)
        if not metrics.objections(config):
            if not metrics.arm_end_seen or attempt > config.arm_end_attempts:
                return path, metrics
            second_choice = second_choice or (path, metrics)
        if second_choice is not None and attempt >= config.arm_end_attempts:
            return second_choice
        if best is None or metrics.visible_fraction_mean > best.visible_fraction_mean:
            best = metrics
    assert best is not None
    raise SamplingError(
        f"camera {index}: none of {config.attempts} candidates is acceptable; the best ({best.kind}) has "
        f"{', '.join(best.objections(config))}; lower cameras.min_visible or cameras.min_object_size, "
        "raise cameras.attempts, or leave this motion out"
    )


def _candidate(
    config: CamerasConfig,
    subject: Subject,
    around: Surroundings,
    rng: np.random.Generator,
    kind: CameraKind,
    azimuth_rad: float,
) -> CameraPath:
    style: PathStyle = getattr(config.styles, kind)
    elevation_deg = style.elevation_deg
    if kind == "egocentric":
        # The head is above the elbow's side of the hand; a forearm that hangs straight says nothing.
        sideways = around.forearm_direction_world[:2]
        if np.linalg.norm(sideways) > 0.3:
            toward_head = np.arctan2(sideways[1], sideways[0])
            azimuth_rad = toward_head + rng.uniform(-1.0, 1.0) * EGOCENTRIC_SPREAD_RAD
    elif around.table_top_z_m is None:
        elevation_deg = config.free_elevation_deg
    view = sample_view_path(
        style,
        config.limits,
        rng,
        n_frames=len(subject.object_center_world),
        fps=subject.fps,
        azimuth_rad=azimuth_rad,
        elevation_deg=elevation_deg,
        slack=config.slack,
    )
    side = min(config.image_size)
    framing = Framing(
        image_size=config.image_size,
        margin_px=config.margin * side,
        near_m=config.near_m,
        max_drift_px=config.max_drift * side,
        smoothing_s=config.smoothing_s,
    )
    K, T_cam_from_world = frame_subject(subject, view, framing)
    return CameraPath(kind=kind, K=K, image_size=config.image_size, T_cam_from_world=T_cam_from_world)


def _measure(
    config: CamerasConfig,
    subject: Subject,
    probe: VisibilityProbe,
    around: Surroundings,
    path: CameraPath,
    attempt: int,
) -> CameraMetrics:
    center = camera_center(path.T_cam_from_world)
    clearance = np.inf
    if around.table_top_z_m is not None:
        clearance = float(center[:, 2].min() - around.table_top_z_m - config.table_clearance_m)
    if around.arm_verts_world.shape[1]:
        to_arm = np.linalg.norm(around.arm_verts_world - center[:, None], axis=-1).min()
        clearance = min(clearance, float(to_arm) - config.arm_clearance_m)
    seen = probe.look(path.K, path.image_size, path.T_cam_from_world)
    distance = np.linalg.norm(center - subject.object_center_world, axis=-1)
    return CameraMetrics(
        kind=path.kind,
        attempts=attempt,
        fov_rad=float(2.0 * np.arctan(0.5 * path.image_size[0] / path.K[0, 0])),
        object_drift_px=image_drift_px(subject.object_center_world, path.K, path.T_cam_from_world),
        min_margin_px=image_margin_px(subject.points_world, path.K, path.T_cam_from_world, path.image_size),
        visible_fraction_min=float(seen.visible_fraction.min()),
        visible_fraction_mean=float(seen.visible_fraction.mean()),
        object_size_px=float(seen.object_size_px.min()),
        arm_end_seen=bool(seen.arm_end_seen.any()),
        distance_m=(float(distance.min()), float(distance.max())),
        clearance_m=clearance,
    )
