"""Colours of OBJ vertices: what follows x y z on their lines, or ZBrush's #MRGB lines."""

import numpy as np
from jaxtyping import Float

__all__ = ["colors_behind_coordinates", "polypaint"]

# Fractions up to here are colours brighter than white; beyond, values count to 255 or 65535.
BRIGHT = 2.0


def colors_behind_coordinates(
    columns: Float[np.ndarray, "vert column"],
) -> tuple[Float[np.ndarray, "vert 3"] | None, tuple[str, ...]]:
    """Display colours 0..1 from the numbers behind x y z (NaN: not given), and notes on guesses.

    They are `r g b` or `r g b a`, or `w r g b` where the first is 1 throughout and the last is not.
    The largest value of the file tells whether they count to 1, 255 or 65535. Vertices with fewer
    than three get NaN; None where no vertex has colours.
    """
    if columns.shape[1] < 3:
        return None, ()
    notes = []
    first = int(_begins_with_weight(columns))
    if first:
        notes.append("vertex lines are read as x y z w r g b (w is 1 throughout)")
    colors = columns[:, first : first + 3].copy()
    colors[~np.isfinite(colors).all(axis=1)] = np.nan
    if np.isnan(colors).all():
        return None, ()
    if np.nanmin(colors) < 0.0:
        return None, ("numbers behind x y z are negative, so no colours, and are left out",)
    largest, given = float(np.nanmax(colors)), colors[np.isfinite(colors)]
    if largest <= 1.0 or (largest <= BRIGHT and (given != np.round(given)).any()):
        scale = 1.0
    else:
        scale = 255.0 if largest <= 255.0 else 65535.0
    return np.clip(colors / scale, 0.0, 1.0), tuple(notes)


def _begins_with_weight(columns: Float[np.ndarray, "vert column"]) -> bool:
    if columns.shape[1] < 4:
        return False
    given = columns[np.isfinite(columns[:, 3])]
    return bool(len(given)) and bool((given[:, 0] == 1.0).all() and (given[:, 3] != 1.0).any())


def polypaint(digits: list[str], n_verts: int) -> Float[np.ndarray, "vert 3"] | None:
    """Display colours 0..1 of what stands on "#MRGB" lines: MMRRGGBB in hexadecimal digits per vertex.

    None where they are not one per vertex.
    """
    try:
        data = bytes.fromhex("".join(digits))
    except ValueError:
        return None
    if not n_verts or len(data) != 4 * n_verts:
        return None
    return np.frombuffer(data, dtype=np.uint8).reshape(-1, 4)[:, 1:] / 255.0
