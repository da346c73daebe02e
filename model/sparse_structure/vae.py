"""Sparse-structure VAE: a 64³ occupancy grid to an 8-channel latent grid and back (FORMATS 4.1).

Values of `VaeConfig`; `paper` has the parameters of ss_enc_conv3d_16l8 and ss_dec_conv3d_16l8:

| field           | paper          | small         | tiny          |
|-----------------|----------------|---------------|---------------|
| patch           | 1              | 2             | 4             |
| channels        | (32, 128, 512) | (64, 128)     | (32, 64, 128) |
| latent_channels | 8              | 8             | 16            |
| residual_blocks | (2, 2, 2)      | (2, 2)        | (1, 1, 1)     |
| middle_blocks   | 2              | 2             | 1             |
| latent of 64³   | 16³            | 16³           | 4³            |

Almost all the time of a CPU would go into the 64³ level, so `tiny` and `small` cut the grid into patches first:
a training step of `tiny` takes a fifth of the time of four levels from 64³ down.
"""

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from model.errors import ModelError
from model.networks.convolution import (
    ChannelLayerNorm,
    Downsample3d,
    ResidualBlock3d,
    Upsample3d,
    pixel_shuffle_3d,
    pixel_unshuffle_3d,
)
from shards.settings import Range

__all__ = [
    "LatentDistribution",
    "StructureDecoder",
    "StructureEncoder",
    "StructureVae",
    "VaeConfig",
    "VaeLoss",
    "occupancy_from_logits",
    "sample_latent",
    "vae_loss",
]


@dataclass(frozen=True, kw_only=True)
class VaeConfig:
    """`channels` and `residual_blocks` per level from fine to coarse; each level halves the one before.

    `patch`: the finest level has a cell for each patch³ voxels.
    """

    patch: Annotated[int, Range(1, 65_536)]
    channels: Annotated[tuple[int, ...], Range(1, 65_536)]
    latent_channels: Annotated[int, Range(1, 65_536)]
    residual_blocks: Annotated[tuple[int, ...], Range(0, 1000)]
    middle_blocks: Annotated[int, Range(0, 1000)]

    def __post_init__(self) -> None:
        if not self.channels or min(*self.channels, self.latent_channels, self.patch) < 1:
            raise ModelError("vae", f"sizes {self}", expected="positive sizes", action="Correct the config.")
        if len(self.residual_blocks) != len(self.channels):
            raise ModelError(
                "vae",
                f"residual_blocks {self.residual_blocks} for {len(self.channels)} levels",
                expected="one count for each entry of `channels`",
                action="Correct the config.",
            )

    @property
    def stride(self) -> int:
        """Voxels per latent cell along an axis."""
        return self.patch * 2 ** (len(self.channels) - 1)

    def latent_shape(self, resolution: int) -> tuple[int, int, int, int]:
        """Channels and cells of the latent of a `resolution`³ grid; ModelError if the stride does not divide it."""
        if resolution % self.stride:
            raise ModelError(
                "vae",
                f"stride {self.stride} does not divide resolution {resolution}",
                expected="a multiple of the stride",
                action="Use another number of levels in `channels`.",
            )
        cells = resolution // self.stride
        return (self.latent_channels, cells, cells, cells)


@dataclass(frozen=True, kw_only=True)
class LatentDistribution:
    """Diagonal Gaussian. The flow learns on `mean`, without normalisation (as TRELLIS)."""

    mean: Float[Tensor, "batch channel i j k"]
    logvar: Float[Tensor, "batch channel i j k"]


class StructureEncoder(nn.Module):
    """Occupancy to latent distribution; names of ss_enc_conv3d_16l8."""

    def __init__(self, config: VaeConfig) -> None:
        super().__init__()
        self.stride, self.patch = config.stride, config.patch
        widths = config.channels
        self.input_layer = nn.Conv3d(config.patch**3, widths[0], 3, padding=1)
        self.blocks = nn.ModuleList()
        for level, width in enumerate(widths):
            self.blocks.extend(ResidualBlock3d(width) for _ in range(config.residual_blocks[level]))
            if level < len(widths) - 1:
                self.blocks.append(Downsample3d(width, widths[level + 1]))
        self.middle_block = nn.Sequential(*[ResidualBlock3d(widths[-1]) for _ in range(config.middle_blocks)])
        self.out_layer = nn.Sequential(
            ChannelLayerNorm(widths[-1]),
            nn.SiLU(),
            nn.Conv3d(widths[-1], 2 * config.latent_channels, 3, padding=1),
        )

    def forward(self, occupancy: Bool[Tensor, "batch i j k"]) -> LatentDistribution:
        """Indices i, j, k run along x, y, z of the canonical frame."""
        if any(extent % self.stride for extent in occupancy.shape[1:]):
            raise ModelError(
                "occupancy",
                f"shape {tuple(occupancy.shape[1:])}",
                expected=f"multiples of {self.stride}",
                action="Voxelise at 64³.",
            )
        grid = occupancy[:, None].to(self.input_layer.weight.dtype)
        h = self.input_layer(pixel_unshuffle_3d(grid, self.patch))
        for block in self.blocks:
            h = block(h)
        mean, logvar = self.out_layer(self.middle_block(h)).chunk(2, dim=1)
        return LatentDistribution(mean=mean, logvar=logvar)


class StructureDecoder(nn.Module):
    """Latent to occupancy logits; names of ss_dec_conv3d_16l8. The encoder mirrored, pixel-shuffle ups."""

    def __init__(self, config: VaeConfig) -> None:
        super().__init__()
        self.patch = config.patch
        widths = config.channels[::-1]
        self.input_layer = nn.Conv3d(config.latent_channels, widths[0], 3, padding=1)
        self.middle_block = nn.Sequential(*[ResidualBlock3d(widths[0]) for _ in range(config.middle_blocks)])
        self.blocks = nn.ModuleList()
        for level, width in enumerate(widths):
            self.blocks.extend(ResidualBlock3d(width) for _ in range(config.residual_blocks[::-1][level]))
            if level < len(widths) - 1:
                self.blocks.append(Upsample3d(width, widths[level + 1]))
        self.out_layer = nn.Sequential(
            ChannelLayerNorm(widths[-1]), nn.SiLU(), nn.Conv3d(widths[-1], config.patch**3, 3, padding=1)
        )

    def forward(
        self, latent: Float[Tensor, "batch channel latent_i latent_j latent_k"]
    ) -> Float[Tensor, "batch i j k"]:
        """Logits; a voxel is occupied where its logit is positive."""
        h = self.middle_block(self.input_layer(latent))
        for block in self.blocks:
            h = block(h)
        return pixel_shuffle_3d(self.out_layer(h), self.patch)[:, 0]


class StructureVae(nn.Module):
    """Encoder and decoder that are trained together."""

    def __init__(self, config: VaeConfig) -> None:
        super().__init__()
        self.encoder = StructureEncoder(config)
        self.decoder = StructureDecoder(config)

    def forward(
        self,
        occupancy: Bool[Tensor, "batch i j k"],
        noise: Float[Tensor, "batch channel latent_i latent_j latent_k"],
    ) -> "VaeLoss":
        """The training loss of a batch, with latents drawn by standard normal noise (`latent_shape`)."""
        latent = self.encoder(occupancy)
        return vae_loss(self.decoder(sample_latent(latent, noise)), latent, occupancy)


def occupancy_from_logits(logits: Float[Tensor, "batch i j k"]) -> Bool[Tensor, "batch i j k"]:
    """occupancy = logit > 0 (FORMATS 4.1)."""
    return logits > 0


def sample_latent(
    latent: LatentDistribution, noise: Float[Tensor, "batch channel i j k"]
) -> Float[Tensor, "batch channel i j k"]:
    """mean + std * noise, noise standard normal."""
    return latent.mean + torch.exp(0.5 * latent.logvar) * noise


KL_WEIGHT = 1e-3


@dataclass(frozen=True, kw_only=True)
class VaeLoss:
    """`total` = mean over samples of dice + 1e-3 kl; both terms per sample, so that a bad sample can be named."""

    total: Float[Tensor, ""]
    dice: Float[Tensor, " batch"]
    kl: Float[Tensor, " batch"]


def vae_loss(
    logits: Float[Tensor, "batch i j k"], latent: LatentDistribution, occupancy: Bool[Tensor, "batch i j k"]
) -> VaeLoss:
    """Dice 1 - (2 sum(p s) + 1) / (sum p + sum s + 1) plus 1e-3 KL to N(0, 1), mean per element (FORMATS 4.1).

    Sums run over one sample (TRELLIS: over the batch), so ranks that share a batch agree with one process.
    """
    probability = logits.float().sigmoid().flatten(1)
    occupied = occupancy.float().flatten(1)
    overlap = 2 * (probability * occupied).sum(1) + 1
    dice = 1 - overlap / (probability.sum(1) + occupied.sum(1) + 1)
    mean, logvar = latent.mean.float().flatten(1), latent.logvar.float().flatten(1)
    kl = 0.5 * (mean.square() + logvar.exp() - logvar - 1).mean(1)
    return VaeLoss(total=(dice + KL_WEIGHT * kl).mean(), dice=dice, kl=kl)
