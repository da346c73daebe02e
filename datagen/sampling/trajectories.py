"""Where a camera looks from over time: smooth paths of direction, roll, slack and aim.

A path says nothing of distances; `framing` solves those from the vertices. Angles: azimuth about
world Z, elevation above the horizon, both of the vector from the target to the camera.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float

from datagen.sampling.errors import SamplingError
from shards.geometry import look_at
from shards.settings import Range

__all__ = ["MotionLimits", "PathStyle", "ViewPath", "band_limited", "sample_view_path", "view_rotations"]

SHAKE_WAVES = 4
MAX_ELEVATION_RAD = np.radians(80.0)  # nearer to the vertical "up" would spin


@dataclass(frozen=True, kw_only=True)
class PathStyle:
    """One kind of camera path. Pairs are (lowest, highest) of a uniform draw."""

    weight: Annotated[float, Range(0, 1e6)]  # relative frequency
    fov_deg: Annotated[tuple[float, float], Range(1, 170, rising=True)]  # horizontal
    elevation_deg: Annotated[tuple[float, float], Range(-90, 90, rising=True)]
    # over the clip, either way round
    azimuth_sweep_deg: Annotated[tuple[float, float], Range(0, 3600, rising=True)]
    # over the clip, up or down
    elevation_sweep_deg: Annotated[tuple[float, float], Range(0, 180, rising=True)]
    # last over first distance, or the reverse
    zoom_out: Annotated[tuple[float, float], Range(1, 100, rising=True)]
    # never nearer to the target than this
    floor_distance_m: Annotated[tuple[float, float], Range(0, 100, rising=True)]
    roll_deg: Annotated[float, Range(0, 180)]  # largest static roll
    shake_deg: Annotated[float, Range(0, 180)]  # largest tremble of direction and roll
    shake_m: Annotated[float, Range(0, 10)]  # largest tremble of the point looked at


@dataclass(frozen=True, kw_only=True)
class MotionLimits:
    """What a camera's rotation may do, whatever its kind."""

    angular_speed_deg_s: Annotated[float, Range(0.01, 1e5)]
    angular_acceleration_deg_s2: Annotated[float, Range(0.01, 1e5)]
    shake_band_hz: Annotated[tuple[float, float], Range(0.001, 1000, rising=True)]


@dataclass(frozen=True, kw_only=True)
class ViewPath:
    """One camera's direction over time. `slack` >= 1 multiplies the distance that just frames the subject."""

    azimuth_rad: Float[np.ndarray, " frame"]
    elevation_rad: Float[np.ndarray, " frame"]
    roll_rad: Float[np.ndarray, " frame"]
    slack: Float[np.ndarray, " frame"]
    aim_world: Float[np.ndarray, "frame 3"]  # metres added to the target
    fov_rad: float
    floor_distance_m: float


def sample_view_path(
    style: PathStyle,
    limits: MotionLimits,
    rng: np.random.Generator,
    *,
    n_frames: int,
    fps: float,
    azimuth_rad: float,
    elevation_deg: tuple[float, float],
    slack: tuple[float, float],
) -> ViewPath:
    """Draw one path about `azimuth_rad`, within the elevations allowed, and tame it to the limits."""
    low, high = np.radians(elevation_deg)
    sign = rng.choice([-1.0, 1.0], size=3)
    ease = _ease(n_frames, rng.uniform(0.0, 1.0)) - 0.5
    sweep = np.radians(rng.uniform(*style.azimuth_sweep_deg)) * sign[0]
    tilt = np.radians(rng.uniform(*style.elevation_sweep_deg)) * sign[1]
    tilt = np.sign(tilt) * min(abs(tilt), high - low)
    middle = rng.uniform(low + 0.5 * abs(tilt), high - 0.5 * abs(tilt))
    shake = band_limited(n_frames, fps, limits.shake_band_hz, rng, 6)
    shake[:3] *= np.radians(style.shake_deg)
    shake[3:] *= style.shake_m
    deviation = np.stack([sweep * ease, tilt * ease, np.zeros(n_frames)]) + shake[:3]
    deviation *= _taming(deviation, limits, fps)
    zoom = rng.uniform(*style.zoom_out)
    grow = _ease(n_frames, 1.0) if sign[2] > 0 else _ease(n_frames, 1.0)[::-1]
    return ViewPath(
        azimuth_rad=azimuth_rad + deviation[0],
        elevation_rad=np.clip(middle + deviation[1], -MAX_ELEVATION_RAD, MAX_ELEVATION_RAD),
        roll_rad=np.radians(rng.uniform(-style.roll_deg, style.roll_deg)) + deviation[2],
        slack=rng.uniform(*slack) * (1.0 + (zoom - 1.0) * grow),
        aim_world=shake[3:].T,
        fov_rad=float(np.radians(rng.uniform(*style.fov_deg))),
        floor_distance_m=float(rng.uniform(*style.floor_distance_m)),
    )


def view_rotations(path: ViewPath) -> Float[np.ndarray, "frame 3 3"]:
    """R_cam_from_world of every frame."""
    outward = np.stack(
        [
            np.cos(path.elevation_rad) * np.cos(path.azimuth_rad),
            np.cos(path.elevation_rad) * np.sin(path.azimuth_rad),
            np.sin(path.elevation_rad),
        ],
        axis=-1,
    )
    return look_at(outward, np.zeros_like(outward), path.roll_rad)[:, :3, :3]


def band_limited(
    n_frames: int, fps: float, band_hz: tuple[float, float], rng: np.random.Generator, channels: int
) -> Float[np.ndarray, "channel frame"]:
    """Smooth noise within +-1: a few sines of random frequency and phase. SamplingError on an empty band."""
    low, high = band_hz[0], min(band_hz[1], fps / 6.0)  # six frames per period at least
    if not 0.0 < low <= high:
        raise SamplingError(
            f"shake band {band_hz} Hz at {fps} fps: expected 0 < lowest <= fps / 6; "
            "lower cameras.limits.shake_band_hz or raise clip.fps"
        )
    shape = (channels, SHAKE_WAVES, 1)
    frequency, phase = rng.uniform(low, high, shape), rng.uniform(0.0, 2.0 * np.pi, shape)
    amplitude = rng.uniform(0.3, 1.0, shape)
    amplitude /= amplitude.sum(axis=1, keepdims=True)
    return np.sum(amplitude * np.sin(2.0 * np.pi * frequency * np.arange(n_frames) / fps + phase), axis=1)


def _ease(n_frames: int, softness: float) -> Float[np.ndarray, " frame"]:
    """0 -> 1 at constant speed (softness 0) or starting and ending slowly (softness 1)."""
    u = np.linspace(0.0, 1.0, n_frames)
    return (1.0 - softness) * u + softness * u * u * (3.0 - 2.0 * u)


def _taming(deviation: Float[np.ndarray, "angle frame"], limits: MotionLimits, fps: float) -> float:
    """Factor <= 1 that keeps the rotation within the limits.

    A rotation made of turns about three axes is no faster than the sum S of their rates, and its
    acceleration no greater than the sum of theirs plus S^2 for the turning of the axes themselves.
    """
    if deviation.shape[1] < 2:
        return 1.0
    speed = np.abs(np.diff(deviation)).sum(axis=0).max() * fps
    acceleration = np.abs(np.diff(deviation, n=2)).sum(axis=0).max(initial=0.0) * fps**2
    max_speed, max_acceleration = np.radians([limits.angular_speed_deg_s, limits.angular_acceleration_deg_s2])
    factor = min(1.0, max_speed / max(speed, 1e-12))
    # speed^2 f^2 + acceleration f <= max_acceleration
    a, b = max(speed**2, 1e-12), acceleration
    return float(min(factor, (np.sqrt(b * b + 4.0 * a * max_acceleration) - b) / (2.0 * a)))
