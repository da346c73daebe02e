"""What the memory tests share: surfaces of growing size, and the tensors that a layer makes of them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from model.networks.sparse.grid import SparseGrid
from model.networks.sparse.tensor import SparseTensor


@dataclass(frozen=True, kw_only=True)
class Memory:
    """Bytes of one forward and backward pass."""

    voxels: int
    kept_for_gradient: int  # each storage once
    largest_tensor: int  # of all that any operation returned, forward or backward


class _LargestTensor(TorchDispatchMode):
    bytes = 0

    def __torch_dispatch__(
        self, func: Callable[..., Any], types: object, args: tuple = (), kwargs: dict[str, Any] | None = None
    ) -> object:
        out = func(*args, **(kwargs or {}))
        for tensor in out if isinstance(out, tuple | list) else [out]:
            if isinstance(tensor, Tensor):
                self.bytes = max(self.bytes, tensor.untyped_storage().nbytes())
        return out


def _shell(resolution: int) -> SparseGrid:
    ticks = (torch.arange(resolution) + 0.5) / resolution - 0.5
    radius = torch.stack(torch.meshgrid(ticks, ticks, ticks, indexing="ij")).norm(dim=0)
    return SparseGrid.from_occupancy(((radius - 0.4).abs() < 0.9 / resolution)[None])


def _memory(layer: Callable[[SparseTensor], SparseTensor], grid: SparseGrid, channels: int) -> Memory:
    kept: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        kept[storage.data_ptr()] = storage.nbytes()
        return tensor

    x = SparseTensor(grid=grid, features=torch.randn(grid.voxels, channels, requires_grad=True))
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor), _LargestTensor() as largest:
        layer(x).features.sum().backward()
    return Memory(voxels=grid.voxels, kept_for_gradient=sum(kept.values()), largest_tensor=largest.bytes)


@pytest.fixture
def shell() -> Callable[[int], SparseGrid]:
    """The voxels of a spherical surface at a resolution: they grow with its square."""
    return _shell


@pytest.fixture
def memory_of() -> Callable[..., Memory]:
    """memory_of(layer, grid, channels) with random features."""
    return _memory
