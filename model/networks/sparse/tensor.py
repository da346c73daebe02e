"""SparseTensor: features on the voxels of a SparseGrid."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
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

    @classmethod
    def from_rows(
        cls,
        *,
        features: Float[Tensor, "voxel channel"],
        coordinates: Int[Tensor, "voxel 3"],
        batch_index: Int[Tensor, " voxel"],
        batch_size: int,
        resolution: int,
    ) -> "SparseTensor":
        """From voxels in any order; ModelError when one occurs twice or lies outside."""
        grid, order = SparseGrid.from_coordinates(
            coordinates=coordinates, batch_index=batch_index, batch_size=batch_size, resolution=resolution
        )
        return cls(grid=grid, features=features[order])

    @classmethod
    def from_samples(
        cls,
        features: Sequence[Float[Tensor, "_ channel"]],
        coordinates: Sequence[Int[Tensor, "_ 3"]],
        resolution: int,
    ) -> "SparseTensor":
        """A batch from samples of different numbers of voxels, each in any order."""
        sizes = torch.tensor([len(rows) for rows in coordinates], device=coordinates[0].device)
        return cls.from_rows(
            features=torch.cat(list(features)),
            coordinates=torch.cat(list(coordinates)),
            batch_index=torch.arange(len(sizes), device=sizes.device).repeat_interleave(sizes),
            batch_size=len(sizes),
            resolution=resolution,
        )

    @classmethod
    def from_dense(
        cls, dense: Float[Tensor, "batch channel i j k"], occupancy: Bool[Tensor, "batch i j k"]
    ) -> "SparseTensor":
        """The features of the occupied cells."""
        return cls(grid=SparseGrid.from_occupancy(occupancy), features=dense.movedim(1, -1)[occupancy])

    def to_dense(self) -> Float[Tensor, "batch channel i j k"]:
        """Dense volumes, zero where no voxel is."""
        size = (self.grid.batch_size, *[self.grid.resolution] * 3)
        flat = self.features.new_zeros(math.prod(size), self.features.shape[1])
        dense = flat.index_copy(0, self.grid.keys, self.features).view(*size, -1)
        return dense.movedim(-1, 1)

    def with_features(self, features: Float[Tensor, "voxel other"]) -> "SparseTensor":
        """Other features on the same grid."""
        return SparseTensor(grid=self.grid, features=features)

    def map(self, layer: Callable[[Tensor], Tensor]) -> "SparseTensor":
        """A layer that works on each row by itself: linear, layer norm, activation."""
        return self.with_features(layer(self.features))

    def to(self, device: torch.device) -> "SparseTensor":
        """Grid and features on a device."""
        return SparseTensor(grid=self.grid.to(device), features=self.features.to(device))
