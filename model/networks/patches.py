"""Grids to patches and back, on any number of axes (TRELLIS order: channel, then offset inside the patch)."""

from jaxtyping import Float
from torch import Tensor

__all__ = ["patchify", "unpatchify"]


def patchify(
    x: Float[Tensor, "batch channel *grid"], patch: int
) -> Float[Tensor, "batch token patch_channel"]:
    """Cut each axis of the grid into patches of `patch`; tokens in row-major order of the coarse grid.

    Channel c of the grid at offset (a, b, ...) becomes channel (c, a, b, ...) of the token, row-major.
    """
    axes = x.ndim - 2
    cut = [extent for size in x.shape[2:] for extent in (size // patch, patch)]
    coarse, offset = [2 + 2 * axis for axis in range(axes)], [3 + 2 * axis for axis in range(axes)]
    tokens = x.reshape(*x.shape[:2], *cut).permute(0, *coarse, 1, *offset)
    return tokens.flatten(1, axes).flatten(2)


def unpatchify(
    tokens: Float[Tensor, "batch token patch_channel"], patch: int, grid: tuple[int, ...]
) -> Float[Tensor, "batch channel *grid"]:
    """The inverse of `patchify` for a fine grid of size `grid`."""
    axes = len(grid)
    coarse = [size // patch for size in grid]
    x = tokens.unflatten(2, (-1, *[patch] * axes)).unflatten(1, coarse)
    pairs = [axis for i in range(axes) for axis in (1 + i, 2 + axes + i)]
    return x.permute(0, 1 + axes, *pairs).reshape(tokens.shape[0], -1, *grid)
