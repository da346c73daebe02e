"""SparseTensor: features on the voxels of a SparseGrid."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from model.errors import ModelError
from model.networks.sparse.grid import SparseGrid

__all__ = ["SparseTensor"]


@dataclass(frozen=True, kw_only=True, eq=False)
class SparseTensor:
    """One feature row per row of `grid`."""

    grid: SparseGrid
    features: Float[Tensor, "voxel channel"]

    def __post_init__(self) -> None:
        if len(self.features) != self.grid.voxels:
            raise ModelError(
                "sparse tensor",
                f"{len(self.features)} feature rows",
                expected=f"{self.grid.voxels}, one per voxel",
                action="Take features and coordinates from the same source.",
            )
        if self.features.device != self.grid.device:
            raise ModelError(
                "sparse tensor",
                f"features on {self.features.device}",
                expected=f"{self.grid.device}, where the coordinates are",
                action="Move one of them.",
            )

    def with_features(self, features: Float[Tensor, "voxel other"]) -> "SparseTensor":
        """Other features on the same grid."""
        return SparseTensor(grid=self.grid, features=features)

    def map(self, layer: Callable[[Tensor], Tensor]) -> "SparseTensor":
        """A layer that works on each row by itself: linear, layer norm, activation."""
        return self.with_features(layer(self.features))

    def to(self, device: torch.device) -> "SparseTensor":
        """Grid and features on a device."""
        return SparseTensor(grid=self.grid.to(device), features=self.features.to(device))
