"""Submanifold convolution: outputs only where inputs are, missing neighbours count as zero."""

import math
from collections.abc import Iterator
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from model.networks.sparse.backends import uses_spconv
from model.networks.sparse.grid import SparseGrid
from model.networks.sparse.neighbours import KernelPairs
from model.networks.sparse.tensor import SparseTensor

__all__ = ["SparseConv3d", "convolve_with_pairs", "convolve_with_spconv", "pointwise_from_spconv"]


class SparseConv3d(nn.Module):
    """Submanifold convolution of odd size; parameters conv.weight [out, k, k, k, in] and conv.bias.

    out(p) = bias + sum over offsets o of weight[:, o] x(p + o): conv3d with zero padding, read at the voxels;
    conv3d's weight is weight.permute(0, 4, 1, 2, 3). The kernel's axes are those of the coordinates, (i, j, k).
    The layout is that of spconv 2 and of the published TRELLIS files, which load as they are, except those of
    size 1: see `pointwise_from_spconv`.
    """

    def __init__(self, in_channels: int, out_channels: int, kernel: int) -> None:
        super().__init__()
        self.kernel = kernel
        self.conv = KernelParameters(in_channels, out_channels, kernel)

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Same grid, other channels."""
        features, weight, bias = _autocast(x.features, self.conv.weight, self.conv.bias)
        if self.kernel > 1 and uses_spconv(features):
            return x.with_features(convolve_with_spconv(x.grid, features, weight, bias))
        return x.with_features(convolve_with_pairs(features, weight, bias, x.grid.neighbours(self.kernel)))


class KernelParameters(nn.Module):
    """Weight [out, k, k, k, in] and bias, drawn as nn.Conv3d draws them."""

    def __init__(self, in_channels: int, out_channels: int, kernel: int) -> None:
        super().__init__()
        bound = 1 / math.sqrt(in_channels * kernel**3)
        size = (out_channels, kernel, kernel, kernel, in_channels)
        self.weight = nn.Parameter(torch.empty(size).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(out_channels).uniform_(-bound, bound))


def convolve_with_pairs(
    features: Float[Tensor, "voxel in"],
    weight: Float[Tensor, "out k k k in"],
    bias: Float[Tensor, " out"],
    pairs: KernelPairs,
) -> Float[Tensor, "voxel out"]:
    """Gather, multiply, add, one kernel cell after another; sums in float32.

    Only pairs that exist are multiplied (60 % of 27 on a shell at 64^3), and nothing of 27 rows per voxel
    ever exists.
    """
    return _PairConvolution.apply(features, weight, bias, pairs)


def convolve_with_spconv(
    grid: SparseGrid,
    features: Float[Tensor, "voxel in"],
    weight: Float[Tensor, "out k k k in"],
    bias: Float[Tensor, " out"],
) -> Float[Tensor, "voxel out"]:
    """The same by spconv 2 for kernels larger than 1; its index pairs are kept with the grid."""
    import spconv.pytorch as spconv

    out_channels, kernel, _, _, in_channels = weight.shape
    # Without memory and without random draws; it only carries the call. The parameters are ours.
    with torch.device("meta"):
        layer = spconv.SubMConv3d(in_channels, out_channels, kernel, indice_key=f"kernel_{kernel}")
    index = torch.cat([grid.batch_index[:, None], grid.coordinates], dim=1).int()
    x = spconv.SparseConvTensor(features, index, [grid.resolution] * 3, grid.batch_size)
    shared: dict[str, Any] = grid.derived("spconv", dict)
    x.indice_dict = shared
    out = torch.func.functional_call(layer, {"weight": weight, "bias": bias}, (x,))
    shared.update(out.indice_dict)  # spconv writes new pairs into a copy
    return out.features


def pointwise_from_spconv(weight: Float[Tensor, "out 1 1 1 in"]) -> Float[Tensor, "out 1 1 1 in"]:
    """Our weight of a kernel of size 1 that was trained with spconv 2.3.

    spconv multiplies by `weight.view(in, out)`, which reads the memory of [out, 1, 1, 1, in] in another order
    instead of transposing it. What such a network learned is that matrix.
    """
    out_channels, *_, in_channels = weight.shape
    return weight.reshape(in_channels, out_channels).T.reshape(weight.shape)


def _steps(pairs: KernelPairs, device: torch.device) -> Iterator[tuple[int, Tensor, Tensor]]:
    """(kernel cell, rows, neighbours), a CPU's cache full at a time: 2.7 times faster at 128^3 than all at once."""
    at_once = 8192 if device.type == "cpu" else 1 << 20
    for cell, rows, neighbours in pairs.around_middle():
        for some_rows, some_neighbours in zip(rows.split(at_once), neighbours.split(at_once), strict=True):
            # Kept in 32 bits, used in 64: index_add_ is four times slower with the former.
            yield cell, some_rows.long(), some_neighbours.long()


def _autocast(*tensors: Tensor) -> list[Tensor]:
    """What autocast does for built-in layers: all in its type, where it is on."""
    device_type = tensors[0].device.type
    if not torch.is_autocast_enabled(device_type):
        return list(tensors)
    return [tensor.to(torch.get_autocast_dtype(device_type)) for tensor in tensors]


class _PairConvolution(torch.autograd.Function):
    """Written out because autograd would keep the gathered rows of every kernel cell: 27 copies of the input."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, bias: Tensor, pairs: KernelPairs) -> Tensor:
        ctx.save_for_backward(features, weight)
        ctx.pairs = pairs
        cells = weight.flatten(1, 3)
        wide = torch.promote_types(features.dtype, torch.float32)
        out = nn.functional.linear(features, cells[:, pairs.middle], bias).to(wide)
        for cell, rows, neighbours in _steps(pairs, features.device):
            out.index_add_(0, rows, (features.index_select(0, neighbours) @ cells[:, cell].T).to(wide))
        return out.to(features.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        features, weight = ctx.saved_tensors
        pairs, cells = ctx.pairs, weight.flatten(1, 3)
        wide = torch.promote_types(features.dtype, torch.float32)
        grad_features = (grad @ cells[:, pairs.middle]).to(wide)
        grad_cells = torch.zeros_like(cells, dtype=wide)
        grad_cells[:, pairs.middle] = grad.T @ features
        for cell, rows, neighbours in _steps(pairs, features.device):
            grad_rows = grad.index_select(0, rows)
            grad_features.index_add_(0, neighbours, (grad_rows @ cells[:, cell]).to(wide))
            grad_cells[:, cell] += grad_rows.T @ features.index_select(0, neighbours)
        grad_bias = grad.sum(0, dtype=wide).to(weight.dtype)
        return (
            grad_features.to(features.dtype),
            grad_cells.view_as(weight).to(weight.dtype),
            grad_bias,
            None,
        )
