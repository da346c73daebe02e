"""Features between grids of different resolution."""

import torch
from jaxtyping import Float
from torch import Tensor

from model.errors import ModelError
from model.networks.sparse.grid import SparseGrid
from model.networks.sparse.tensor import SparseTensor

__all__ = ["mean_pool", "subdivide", "unpool"]


def mean_pool(x: SparseTensor, factor: int, *, pseudo_count: int) -> SparseTensor:
    """Per coarser cell, the sum over its voxels divided by their number + `pseudo_count`; cells without any stay out.

    0 is the mean. The published TRELLIS flow was trained with 1 (its scatter counts the zero it starts from,
    so two voxels of value 1 give 2/3); networks that load it must use 1.
    """
    coarsening = x.grid.coarsened(factor)
    total = torch.zeros(
        coarsening.coarse.voxels, x.features.shape[1], dtype=torch.float32, device=x.features.device
    ).index_add(0, coarsening.parent, x.features.float())
    mean = total / (coarsening.children[:, None] + pseudo_count)
    return SparseTensor(grid=coarsening.coarse, features=mean.to(x.features.dtype))


def unpool(x: SparseTensor, onto: SparseGrid) -> SparseTensor:
    """Each voxel of `onto` takes the features of the coarser cell it lies in: the way back from `mean_pool`.

    ModelError when x's grid is not `onto` coarsened by a whole factor.
    """
    factor = max(onto.resolution // x.grid.resolution, 1)
    coarsening = onto.coarsened(factor)
    if not coarsening.coarse.same_voxels(x.grid):
        raise ModelError(
            "unpool",
            f"{x.grid.voxels} voxels at {x.grid.resolution}^3 are not the cells of {onto.voxels} voxels "
            f"at {onto.resolution}^3",
            expected="a tensor pooled from that grid",
            action="Keep the grid that mean_pool was given.",
        )
    return SparseTensor(grid=onto, features=_take(x.features, coarsening.parent))


def subdivide(x: SparseTensor) -> SparseTensor:
    """Twice the resolution: each voxel becomes eight with its features."""
    subdivision = x.grid.subdivided()
    return SparseTensor(grid=subdivision.fine, features=_take(x.features, subdivision.parent))


def _take(features: Float[Tensor, "coarse channel"], parent: torch.Tensor) -> Float[Tensor, "fine channel"]:
    # index_select, not indexing: its gradient is an index_add, not a sort.
    return features.index_select(0, parent)
