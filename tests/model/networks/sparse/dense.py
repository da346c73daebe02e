"""Between sparse tensors and what they stand for: dense volumes, and samples of any number of voxels."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from model.networks.sparse.grid import SparseGrid
from model.networks.sparse.tensor import SparseTensor


def from_dense(
    dense: Float[Tensor, "batch channel i j k"], occupancy: Bool[Tensor, "batch i j k"]
) -> SparseTensor:
    """The features of the occupied cells."""
    return SparseTensor(grid=SparseGrid.from_occupancy(occupancy), features=dense.movedim(1, -1)[occupancy])


def to_dense(x: SparseTensor) -> Float[Tensor, "batch channel i j k"]:
    """Dense volumes, zero where no voxel is."""
    size = (x.grid.batch_size, *[x.grid.resolution] * 3)
    flat = x.features.new_zeros(math.prod(size), x.features.shape[1])
    return flat.index_copy(0, x.grid.keys, x.features).view(*size, -1).movedim(-1, 1)


def occupancy_of(grid: SparseGrid) -> Bool[Tensor, "batch i j k"]:
    """True where a voxel is."""
    size = (grid.batch_size, *[grid.resolution] * 3)
    occupancy = torch.zeros(size, dtype=torch.bool, device=grid.device)
    occupancy.view(-1)[grid.keys] = True
    return occupancy


def from_samples(
    features: Sequence[Float[Tensor, "_ channel"]], coordinates: Sequence[Int[Tensor, "_ 3"]], resolution: int
) -> SparseTensor:
    """A batch from samples of different numbers of voxels, each in any order."""
    sizes = torch.tensor([len(rows) for rows in coordinates])
    grid, order = SparseGrid.from_coordinates(
        coordinates=torch.cat(list(coordinates)),
        batch_index=torch.arange(len(sizes)).repeat_interleave(sizes),
        batch_size=len(sizes),
        resolution=resolution,
    )
    return SparseTensor(grid=grid, features=torch.cat(list(features))[order])
