"""Where the fingernails of the open hand are in its texture."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

__all__ = ["nail_plates"]


@dataclass(frozen=True, kw_only=True)
class _Plate:
    """Rounded outline of one nail, pixels of a 1024 texture whose row 0 is at the top."""

    center: tuple[float, float]  # column, row
    half_across: float
    half_along: float
    tip_deg: float  # direction of the finger's tip: 0 along columns, 90 along rows


# Read off the painted skins; the layout never changes, however the hand is reshaped.
_PLATES = (
    _Plate(center=(932.9, 782.1), half_across=16.9, half_along=18.9, tip_deg=61.0),  # thumb
    _Plate(center=(738.2, 990.6), half_across=16.1, half_along=20.5, tip_deg=68.0),  # index
    _Plate(center=(444.9, 1001.6), half_across=15.8, half_along=21.8, tip_deg=112.0),  # middle
    _Plate(center=(277.6, 844.1), half_across=13.9, half_along=20.6, tip_deg=143.0),  # ring
    _Plate(center=(246.2, 652.4), half_across=12.2, half_along=13.6, tip_deg=174.0),  # little
)
_ROUNDNESS = 2.5  # exponent of the outline: 2 is an ellipse, more is squarer


def nail_plates(size: int) -> tuple[Float[np.ndarray, "row column"], Float[np.ndarray, "row column"]]:
    """How much of each texel is nail (0..1), and how near it lies to the nail's free edge (0..1)."""
    scale = 1024.0 / size
    row, column = (np.mgrid[:size, :size] + 0.5) * scale - 0.5
    plate, free_edge = np.zeros((size, size)), np.zeros((size, size))
    for nail in _PLATES:
        tip = np.radians(nail.tip_deg)
        right, down = column - nail.center[0], row - nail.center[1]
        along = (right * np.cos(tip) + down * np.sin(tip)) / nail.half_along
        across = (down * np.cos(tip) - right * np.sin(tip)) / nail.half_across
        outline = (np.abs(across) ** _ROUNDNESS + np.abs(along) ** _ROUNDNESS) ** (1.0 / _ROUNDNESS)
        inside = np.clip((1.05 - outline) / 0.12, 0.0, 1.0)
        plate = np.maximum(plate, inside)
        edge = np.clip((np.maximum(along, 0.0) ** 2 + 0.35 * across**2 - 0.55) / 0.15, 0.0, 1.0)
        free_edge = np.maximum(free_edge, edge * (outline < 1.2))
    return plate, free_edge
