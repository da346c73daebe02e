"""How far a motion turns and carries its object."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

__all__ = ["Movement", "measure_movement"]

INSTANTS = 24


@dataclass(frozen=True, kw_only=True)
class Movement:
    """Degree of object movement, one of the paper's two selection measures."""

    rotation_range_rad: float  # largest angle between any two instants
    travel_m: float  # length of the path of the object's centre


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
    )
