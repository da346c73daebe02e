"""How much a motion shows of its object."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

__all__ = ["Movement", "measure_movement"]

CAMERAS = 8  # standing around the scene, at rest
CAMERA_ELEVATION_RAD = np.deg2rad(30.0)
FACING = 0.25  # a surface is seen when its normal and the view direction have this cosine
INSTANTS = 24


@dataclass(frozen=True, kw_only=True)
class Movement:
    """Degree of object movement, one of the paper's two selection measures."""

    rotation_range_rad: float  # largest angle between any two instants
    travel_m: float  # length of the path of the object's centre
    view_coverage: float  # share of surface directions that a resting camera sees, mean over cameras


def measure_movement(T_world_from_obj: Float[np.ndarray, "frame 4 4"]) -> Movement:
    """Movement over the given frames (ValueError when there are none)."""
    if len(T_world_from_obj) == 0:
        raise ValueError("movement of an empty motion: pass at least one frame")
    rows = np.unique(np.linspace(0, len(T_world_from_obj) - 1, INSTANTS).round().astype(int))
    R = T_world_from_obj[rows, :3, :3]
    trace = np.einsum("aij,bij->ab", R, R)
    path = np.linalg.norm(np.diff(T_world_from_obj[:, :3, 3], axis=0), axis=1)
    return Movement(
        rotation_range_rad=float(np.arccos(np.clip((trace.min() - 1.0) / 2.0, -1.0, 1.0))),
        travel_m=float(path.sum()),
        view_coverage=_coverage(R),
    )


def _coverage(R_world_from_obj: Float[np.ndarray, "instant 3 3"]) -> float:
    around = np.linspace(0.0, 2.0 * np.pi, CAMERAS, endpoint=False)
    level, up = np.cos(CAMERA_ELEVATION_RAD), np.sin(CAMERA_ELEVATION_RAD)
    to_camera = np.stack([level * np.cos(around), level * np.sin(around), np.full(CAMERAS, up)], 1)
    k = np.arange(300) + 0.5  # Fibonacci sphere
    z, turn = 1.0 - 2.0 * k / 300.0, np.pi * (1.0 + 5.0**0.5) * k
    radius = np.sqrt(1.0 - z * z)
    normals_obj = np.stack([radius * np.cos(turn), radius * np.sin(turn), z], 1)
    to_camera_obj = np.einsum("tji,cj->cti", R_world_from_obj, to_camera)
    seen = np.einsum("cti,ni->ctn", to_camera_obj, normals_obj) > FACING
    return float(seen.any(1).mean())
