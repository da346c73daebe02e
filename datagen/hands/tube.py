"""Triangles of tubes: rows of vertices around an axis, an end gathered in one point (its apex)."""

import numpy as np
from jaxtyping import Float, Int

__all__ = ["close_end", "tube_corner_uv", "tube_faces"]


def tube_faces(n_rows: int, n_columns: int) -> Int[np.ndarray, "face 3"]:
    """Two triangles per cell; vertex (row, column) has number row * n_columns + column.

    They face away from the axis when the columns run clockwise seen along the rows' direction,
    which is how `HandModel.wrist_loop` runs seen from the hand.
    """
    row, column = np.divmod(np.arange((n_rows - 1) * n_columns), n_columns)
    a = row * n_columns + column
    b = row * n_columns + (column + 1) % n_columns
    return np.concatenate(
        [np.stack([b, a, a + n_columns], axis=1), np.stack([b, a + n_columns, b + n_columns], axis=1)]
    )


def close_end(row: Int[np.ndarray, " column"], apex: int, *, at_start: bool) -> Int[np.ndarray, "column 3"]:
    """Fan from the first or last row of a tube to its apex, facing as `tube_faces` does."""
    following = np.roll(row, -1)
    pair = [row, following] if at_start else [following, row]
    return np.stack([*pair, np.full(len(row), apex)], axis=1)


def tube_corner_uv(
    faces: Int[np.ndarray, "face 3"], n_columns: int, v_of_row: Float[np.ndarray, " row"]
) -> Float[np.ndarray, "face 3 2"]:
    """u once around, v as given per row; vertices past the last row are apexes (start, end)."""
    n_rows = len(v_of_row)
    row, column = np.divmod(faces, n_columns)
    apex = faces >= n_rows * n_columns
    u = column / n_columns
    u += (u < 0.25) & (np.where(apex, 0.0, u).max(axis=1, keepdims=True) > 0.75)  # the seam
    u = np.where(apex, np.where(apex, 0.0, u).sum(axis=1, keepdims=True) / 2.0, u)
    at_start = apex & (faces == n_rows * n_columns)
    v = np.where(at_start, v_of_row[0], v_of_row[np.minimum(row, n_rows - 1)])
    return np.stack([u, v], axis=-1)
