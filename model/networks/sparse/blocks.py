"""Convolution blocks of the structured-latent networks of TRELLIS, with its parameter names."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from model.networks.sparse.convolution import SparseConv3d
from model.networks.sparse.resampling import subdivide
from model.networks.sparse.tensor import SparseTensor
from model.networks.sparse.transformer import scale_and_shift
from model.networks.transformer import layer_norm

__all__ = ["SparseGroupNorm", "SparseResBlock3d", "SparseSubdivideBlock3d"]


class SparseResBlock3d(nn.Module):
    """skip(x) + conv2(SiLU(adaLN(conv1(SiLU(norm1(x)))))); conv2 starts at zero, so the block starts as skip(x).

    Published blocks that pool or unpool do so before anything else: call it on the pooled or unpooled tensor.
    """

    def __init__(self, in_channels: int, out_channels: int, t_channels: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(in_channels, eps=1e-6)
        self.conv1 = SparseConv3d(in_channels, out_channels, 3)
        self.conv2 = SparseConv3d(out_channels, out_channels, 3)
        self.emb_layers = nn.Sequential(nn.SiLU(), nn.Linear(t_channels, 2 * out_channels))
        same = in_channels == out_channels
        self.skip_connection = nn.Identity() if same else nn.Linear(in_channels, out_channels)
        _zero(self.conv2)

    def forward(self, x: SparseTensor, t_embedding: Float[Tensor, "batch t_channel"]) -> SparseTensor:
        """Same grid, `out_channels`."""
        scale, shift = self.emb_layers(t_embedding).chunk(2, dim=1)
        h = self.conv1(x.map(self.norm1).map(nn.functional.silu)).map(layer_norm)
        h = self.conv2(scale_and_shift(h, scale, shift).map(nn.functional.silu))
        return h.with_features(h.features + self.skip_connection(x.features))


class SparseSubdivideBlock3d(nn.Module):
    """Twice the resolution: skip(sub(x)) + conv(SiLU(norm(conv(sub(SiLU(norm(x))))))); the last conv starts at zero."""

    def __init__(self, in_channels: int, out_channels: int, groups: int) -> None:
        super().__init__()
        self.act_layers = nn.Sequential(SparseGroupNorm(groups, in_channels), SparseSiLU())
        self.out_layers = nn.Sequential(
            SparseConv3d(in_channels, out_channels, 3),
            SparseGroupNorm(groups, out_channels),
            SparseSiLU(),
            SparseConv3d(out_channels, out_channels, 3),
        )
        same = in_channels == out_channels
        self.skip_connection = nn.Identity() if same else SparseConv3d(in_channels, out_channels, 1)
        _zero(self.out_layers[3])

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Eight times the voxels, `out_channels`."""
        h = self.out_layers(subdivide(self.act_layers(x)))
        # The skip's 1x1x1 convolution before subdividing instead of after: the same numbers for an eighth of the work.
        return h.with_features(h.features + subdivide(self.skip_connection(x)).features)


class SparseGroupNorm(nn.Module):
    """Group norm over all voxels of a sample and the channels of a group, in float32; published: 32 groups."""

    def __init__(self, groups: int, channels: int) -> None:
        super().__init__()
        self.groups = groups
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Same grid and dtype."""
        samples = x.features.split(x.grid.sample_sizes)
        return x.with_features(torch.cat([self._sample(rows) for rows in samples]))

    def _sample(self, rows: Float[Tensor, "voxel channel"]) -> Float[Tensor, "voxel channel"]:
        if len(rows) == 0:
            return rows
        # As an image of one column in channels-last memory, which is how the rows already lie.
        image = rows.T[None, :, :, None].float()
        normed = nn.functional.group_norm(image, self.groups, self.weight.float(), self.bias.float())
        return normed[0, :, :, 0].T.to(rows.dtype)


class SparseSiLU(nn.Module):
    """SiLU on each feature."""

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Same grid and channels."""
        return x.map(nn.functional.silu)


def _zero(layer: nn.Module) -> None:
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
