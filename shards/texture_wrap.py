"""What a texture shows beyond its borders, as the samplers of glTF say it; meshes in shards have them."""

from typing import Literal

import numpy as np

from shards.array_types import Int

__all__ = ["WRAPS", "Wrap", "wrapped_texel"]

Wrap = Literal["repeat", "mirror", "clamp"]

WRAPS: dict[int, Wrap] = {10497: "repeat", 33648: "mirror", 33071: "clamp"}  # codes of wrapS and wrapT


def wrapped_texel(index: Int[np.ndarray, " point"], count: int, wrap: Wrap) -> Int[np.ndarray, " point"]:
    """The texel of a row of `count` that is seen at an index beyond it."""
    if wrap == "clamp":
        return np.clip(index, 0, count - 1)
    if wrap == "repeat":
        return index % count
    within = index % (2 * count)
    return np.where(within < count, within, 2 * count - 1 - within)
