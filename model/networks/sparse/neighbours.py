"""Which voxels a convolution kernel connects."""

import itertools
from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from model.errors import ModelError

__all__ = ["KernelPairs", "kernel_pairs"]


@dataclass(frozen=True, kw_only=True, eq=False)
class KernelPairs:
    """For each kernel offset, which row (first) has which other row (second) at that offset.

    Kernel cells count row-major, so cell `middle` is the voxel itself. Only the cells before it are kept: an
    offset's mirror image connects the same rows the other way round.
    """

    before_middle: tuple[tuple[Int[Tensor, " _"], Int[Tensor, " _"]], ...]

    @property
    def middle(self) -> int:
        """Index of the central kernel cell."""
        return len(self.before_middle)

    def around_middle(self) -> list[tuple[int, Int[Tensor, " _"], Int[Tensor, " _"]]]:
        """(kernel cell, rows, their neighbours in that cell) for all cells but the middle."""
        cells = []
        for cell, (rows, neighbours) in enumerate(self.before_middle):
            cells += [(cell, rows, neighbours), (2 * self.middle - cell, neighbours, rows)]
        return cells


def kernel_pairs(
    coordinates: Int[Tensor, "voxel 3"], keys: Int[Tensor, " voxel"], resolution: int, kernel: int
) -> KernelPairs:
    """Pairs by binary search in the ascending keys: no hash table, and no volume the size of the grid."""
    if kernel < 1 or kernel % 2 == 0:
        raise ModelError(
            "sparse convolution", f"kernel {kernel}", expected="an odd size", action="Use 1, 3, 5 ..."
        )
    reach = range(-(kernel // 2), kernel // 2 + 1)
    offsets = list(itertools.product(reach, repeat=3))
    return KernelPairs(
        before_middle=tuple(
            _pairs_at(offset, coordinates, keys, resolution) for offset in offsets[: len(offsets) // 2]
        )
    )


def _pairs_at(
    offset: tuple[int, ...],
    coordinates: Int[Tensor, "voxel 3"],
    keys: Int[Tensor, " voxel"],
    resolution: int,
) -> tuple[Int[Tensor, " pair"], Int[Tensor, " pair"]]:
    di, dj, dk = offset
    moved = coordinates + coordinates.new_tensor(offset)
    rows = ((moved >= 0) & (moved < resolution)).all(1).nonzero()[:, 0]
    wanted = keys[rows] + (di * resolution + dj) * resolution + dk
    found = torch.searchsorted(keys, wanted).clamp_(max=max(len(keys) - 1, 0))
    hit = keys[found] == wanted
    # 32 bits: at 256^3 the pairs are the largest thing kept besides the features.
    return rows[hit].int(), found[hit].int()
