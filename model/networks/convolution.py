"""3D convolution blocks of the sparse-structure VAE (FORMATS 4.1)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

__all__ = [
    "ChannelLayerNorm",
    "Downsample3d",
    "ResidualBlock3d",
    "Upsample3d",
    "pixel_shuffle_3d",
    "pixel_unshuffle_3d",
]


class ChannelLayerNorm(nn.Module):
    """Layer norm over the channels of each voxel, in float32."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Float[Tensor, "batch channel i j k"]) -> Float[Tensor, "batch channel i j k"]:
        """Same shape and dtype as x."""
        normed = nn.functional.layer_norm(
            x.movedim(1, -1).float(), self.weight.shape, self.weight.float(), self.bias.float()
        )
        # Left in channels-last memory: the convolution that follows is faster for it (CPU and GPU).
        return normed.to(x.dtype).movedim(-1, 1)


class ResidualBlock3d(nn.Module):
    """x + conv2(SiLU(norm2(conv1(SiLU(norm1(x)))))); conv2 starts at zero, so the block starts as identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm1 = ChannelLayerNorm(channels)
        self.norm2 = ChannelLayerNorm(channels)
        self.conv1 = nn.Conv3d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv3d(channels, channels, 3, padding=1)
        nn.init.zeros_(self.conv2.weight)
        assert self.conv2.bias is not None
        nn.init.zeros_(self.conv2.bias)

    def forward(self, x: Float[Tensor, "batch channel i j k"]) -> Float[Tensor, "batch channel i j k"]:
        """Same shape as x."""
        h = self.conv1(nn.functional.silu(self.norm1(x)))
        return x + self.conv2(nn.functional.silu(self.norm2(h)))


class Downsample3d(nn.Module):
    """Half the resolution by a convolution of size and stride 2."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv3d(in_channels, out_channels, 2, stride=2)

    def forward(self, x: Float[Tensor, "batch in i j k"]) -> Float[Tensor, "batch out half_i half_j half_k"]:
        """Axes must be even."""
        return self.conv(x)


def pixel_shuffle_3d(
    x: Float[Tensor, "batch channel i j k"], factor: int
) -> Float[Tensor, "batch out fine_i fine_j fine_k"]:
    """Channel (c, a, b, d) of voxel (i, j, k) becomes channel c of voxel (i f + a, j f + b, k f + d)."""
    batch, channels, *size = x.shape
    x = x.reshape(batch, channels // factor**3, factor, factor, factor, *size)
    return x.permute(0, 1, 5, 2, 6, 3, 7, 4).reshape(batch, -1, *[factor * extent for extent in size])


def pixel_unshuffle_3d(
    x: Float[Tensor, "batch channel fine_i fine_j fine_k"], factor: int
) -> Float[Tensor, "batch out i j k"]:
    """The inverse of `pixel_shuffle_3d`; `factor` divides every axis."""
    batch, channels, *size = x.shape
    i, j, k = (extent // factor for extent in size)
    x = x.reshape(batch, channels, i, factor, j, factor, k, factor)
    return x.permute(0, 1, 3, 5, 7, 2, 4, 6).reshape(batch, channels * factor**3, i, j, k)


class Upsample3d(nn.Module):
    """Twice the resolution: a 3x3x3 convolution to 8 times the channels, then pixel shuffle."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv3d(in_channels, 8 * out_channels, 3, padding=1)

    def forward(self, x: Float[Tensor, "batch in i j k"]) -> Float[Tensor, "batch out fine_i fine_j fine_k"]:
        """The output axes are twice as long."""
        return pixel_shuffle_3d(self.conv(x), 2)
