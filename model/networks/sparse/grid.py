"""SparseGrid: which voxels are occupied, and what follows from it, computed once for all layers that share it."""

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from model.errors import ModelError
from model.networks.sparse.neighbours import KernelPairs, kernel_pairs
from model.networks.sparse.sequences import Sequences, Window

__all__ = ["Coarsening", "SparseGrid", "Subdivision"]

_Derived = TypeVar("_Derived")


@dataclass(frozen=True, kw_only=True, eq=False)
class SparseGrid:
    """Occupied voxels (i, j, k) of `batch_size` cubic grids of `resolution` cells per axis.

    Rows ascend by (sample, i, j, k), as `torch.nonzero` lists them, so those of a sample stand together and
    every voxel has one row. Any sample may be empty. Immutable; neighbour maps, windows and coarser or finer
    grids are derived when first asked for and kept, so tensors and layers on one grid share them.
    """

    coordinates: Int[Tensor, "voxel 3"]
    batch_index: Int[Tensor, " voxel"]
    batch_size: int
    resolution: int
    _derived: dict[Hashable, Any] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if len(self.coordinates) == 0:
            return
        low, high = self.coordinates.min(), self.coordinates.max()
        first, last = self.batch_index.min(), self.batch_index.max()
        step = self.keys.diff().min() if self.voxels > 1 else torch.ones_like(low)
        # One transfer from the device for all checks.
        low_, high_, first_, last_, step_ = torch.stack([low, high, first, last, step]).tolist()
        if low_ < 0 or high_ >= self.resolution:
            raise _grid_error(f"coordinates from {low_} to {high_}", f"0 to {self.resolution - 1}")
        if first_ < 0 or last_ >= self.batch_size:
            raise _grid_error(f"batch index from {first_} to {last_}", f"0 to {self.batch_size - 1}")
        if step_ == 0:
            raise _grid_error("a voxel occurs twice", "every voxel of a sample once")
        if step_ < 0:
            raise _grid_error("rows are not ascending", "the order of (sample, i, j, k)")

    @classmethod
    def from_coordinates(
        cls,
        *,
        coordinates: Int[Tensor, "voxel 3"],
        batch_index: Int[Tensor, " voxel"],
        batch_size: int,
        resolution: int,
    ) -> tuple["SparseGrid", Int[Tensor, " voxel"]]:
        """Grid of voxels in any order, and the row of the input that each row of the grid came from."""
        order = _keys(coordinates.long(), batch_index.long(), resolution).argsort()
        grid = cls(
            coordinates=coordinates.long()[order],
            batch_index=batch_index.long()[order],
            batch_size=batch_size,
            resolution=resolution,
        )
        return grid, order

    @classmethod
    def from_occupancy(cls, occupancy: Bool[Tensor, "batch i j k"]) -> "SparseGrid":
        """Grid of the true cells of cubic volumes; ModelError when they are not cubic."""
        batch_size, *size = occupancy.shape
        if len(set(size)) != 1:
            raise _grid_error(f"occupancy of {size} cells", "a cube")
        index = occupancy.nonzero()
        return cls(
            coordinates=index[:, 1:].contiguous(),
            batch_index=index[:, 0].contiguous(),
            batch_size=batch_size,
            resolution=size[0],
        )

    @property
    def voxels(self) -> int:
        """Number of rows, all samples together."""
        return len(self.coordinates)

    @property
    def device(self) -> torch.device:
        """Where the coordinates are."""
        return self.coordinates.device

    @cached_property
    def keys(self) -> Int[Tensor, " voxel"]:
        """((sample R + i) R + j) R + k, ascending."""
        return _keys(self.coordinates, self.batch_index, self.resolution)

    @cached_property
    def sample_sizes(self) -> tuple[int, ...]:
        """Voxels of each sample; `features.split(sample_sizes)` gives the rows of each."""
        return tuple(self.batch_index.bincount(minlength=self.batch_size).tolist())

    @cached_property
    def samples(self) -> Sequences:
        """One sequence per sample: full attention."""
        return Sequences(rows=None, lengths=self.sample_sizes)

    def derived(self, key: Hashable, build: Callable[[], _Derived]) -> _Derived:
        """What `build` makes of the coordinates, made once per key."""
        if key not in self._derived:
            self._derived[key] = build()
        return self._derived[key]

    def neighbours(self, kernel: int) -> KernelPairs:
        """Pairs of rows that a kernel of odd size connects."""
        return self.derived(
            ("neighbours", kernel),
            lambda: kernel_pairs(self.coordinates, self.keys, self.resolution, kernel),
        )

    def windows(self, window: Window) -> Sequences:
        """One sequence per occupied window of a sample."""
        return self.derived(("windows", window), lambda: self._windows(window))

    def _windows(self, window: Window) -> Sequences:
        cell = (self.coordinates + window.shift) // window.size
        across = (self.resolution - 1 + window.shift) // window.size + 1
        _, members, lengths = _keys(cell, self.batch_index, across).unique(
            return_inverse=True, return_counts=True
        )
        return Sequences(rows=members.argsort(stable=True), lengths=tuple(lengths.tolist()))

    def coarsened(self, factor: int) -> "Coarsening":
        """Grid of the coarser cells that hold a voxel; `factor` must divide the resolution, else ModelError."""
        return self.derived(("coarsened", factor), lambda: self._coarsened(factor))

    def _coarsened(self, factor: int) -> "Coarsening":
        if self.resolution % factor:
            raise _grid_error(f"factor {factor}, resolution {self.resolution}", "a factor that divides it")
        resolution = self.resolution // factor
        cell_keys, parent = _keys(self.coordinates // factor, self.batch_index, resolution).unique(
            return_inverse=True
        )
        cell, k = cell_keys // resolution, cell_keys % resolution
        cell, j = cell // resolution, cell % resolution
        coarse = SparseGrid(
            coordinates=torch.stack([cell % resolution, j, k], dim=1),
            batch_index=cell // resolution,
            batch_size=self.batch_size,
            resolution=resolution,
        )
        return Coarsening(coarse=coarse, parent=parent, children=parent.bincount(minlength=coarse.voxels))

    def subdivided(self) -> "Subdivision":
        """Grid of twice the resolution in which each voxel has become its eight children."""
        return self.derived("subdivided", self._subdivided)

    def _subdivided(self) -> "Subdivision":
        bits = torch.tensor([0, 1], device=self.device)
        corner = torch.cartesian_prod(bits, bits, bits)
        fine, order = SparseGrid.from_coordinates(
            coordinates=(2 * self.coordinates[:, None] + corner).flatten(0, 1),
            batch_index=self.batch_index.repeat_interleave(8),
            batch_size=self.batch_size,
            resolution=2 * self.resolution,
        )
        return Subdivision(fine=fine, parent=order // 8)

    def same_voxels(self, other: "SparseGrid") -> bool:
        """Whether both have the same rows, so that features of one may be taken for those of the other."""
        if self is other:
            return True
        sizes = (self.batch_size, self.resolution) == (other.batch_size, other.resolution)
        return sizes and torch.equal(self.keys, other.keys)

    def to(self, device: torch.device) -> "SparseGrid":
        """The same voxels on a device; itself when already there. Derived maps are made anew."""
        if device == self.device:
            return self
        return SparseGrid(
            coordinates=self.coordinates.to(device),
            batch_index=self.batch_index.to(device),
            batch_size=self.batch_size,
            resolution=self.resolution,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Coarsening:
    """A coarser grid, the coarse row of each fine row, and how many fine rows a coarse row has (1 to factor^3)."""

    coarse: SparseGrid
    parent: Int[Tensor, " fine"]
    children: Int[Tensor, " coarse"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Subdivision:
    """A finer grid and the coarse row of each fine row."""

    fine: SparseGrid
    parent: Int[Tensor, " fine"]


def _keys(
    coordinates: Int[Tensor, "voxel 3"], batch_index: Int[Tensor, " voxel"], resolution: int
) -> Int[Tensor, " voxel"]:
    i, j, k = coordinates.unbind(1)
    return ((batch_index * resolution + i) * resolution + j) * resolution + k


def _grid_error(problem: str, expected: str) -> ModelError:
    return ModelError("sparse grid", problem, expected=expected, action="Check where the voxels come from.")
