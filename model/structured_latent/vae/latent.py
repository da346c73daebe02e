"""Structured latents: features on the occupied voxels of an object, their distribution and their normalisation."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor, nn

from model.errors import ModelError
from model.networks.attention import require_heads
from model.networks.sparse.tensor import SparseTensor
from shards.settings import Range

__all__ = ["LatentNormalisation", "SlatDistribution", "SlatVaeConfig", "require_layout", "sample"]


@dataclass(frozen=True, kw_only=True)
class SlatVaeConfig:
    """Sizes of encoder and decoders, which have the same trunk.

    | field            | paper     | meaning |
    |------------------|-----------|---------|
    | feature_channels | 1024      | features of a voxel that the encoder reads |
    | channels         | 768       | width of the trunk |
    | latent_channels  | 8         | |
    | blocks, heads    | 12, 12    | |
    | mlp_ratio        | 4         | |
    | window           | 8         | voxels along an attention window; every other block shifts it by half |
    | upsample         | (192, 96) | width after each doubling of the surface decoder's resolution |
    | resolution       | 64        | of the latent grid |
    """

    feature_channels: Annotated[int, Range(1, 65_536)]
    channels: Annotated[int, Range(1, 65_536)]
    latent_channels: Annotated[int, Range(1, 65_536)]
    blocks: Annotated[int, Range(1, 65_536)]
    heads: Annotated[int, Range(1, 65_536)]
    mlp_ratio: Annotated[int, Range(1, 65_536)]
    window: Annotated[int, Range(1, 65_536)]
    upsample: Annotated[tuple[int, ...], Range(1, 65_536)]
    resolution: Annotated[int, Range(1, 65_536)]

    def __post_init__(self) -> None:
        sizes = (self.feature_channels, self.channels, self.latent_channels, self.heads, self.mlp_ratio)
        if min(*sizes, self.window, self.resolution, *self.upsample) < 1 or self.blocks < 0:
            raise ModelError("slat vae", f"sizes {self}", expected="positive sizes", action="Correct them.")
        require_heads("slat vae", self.channels, self.heads)


@dataclass(frozen=True, kw_only=True, eq=False)
class SlatDistribution:
    """Diagonal Gaussian of the latent of each voxel, both on one grid. The flow learns on `mean` (as TRELLIS)."""

    mean: SparseTensor
    logvar: SparseTensor


def sample(distribution: SlatDistribution, noise: Float[Tensor, "voxel latent"]) -> SparseTensor:
    """mean + std * noise, noise standard normal."""
    std = torch.exp(0.5 * distribution.logvar.features)
    return distribution.mean.with_features(distribution.mean.features + std * noise)


class LatentNormalisation(nn.Module):
    """The flow's latents are (latent - mean) / std per channel. Buffers, so a checkpoint carries its own."""

    mean: Tensor
    std: Tensor

    def __init__(self, mean: Float[Tensor, " latent"], std: Float[Tensor, " latent"]) -> None:
        super().__init__()
        if mean.device.type != "meta" and not bool((std > 0).all()):
            raise ModelError(
                "latent normalisation",
                f"std {std.tolist()}",
                expected="positive standard deviations",
                action="A channel that never varies carries nothing: train the VAE longer or lower its KL weight.",
            )
        self.register_buffer("mean", mean.float())
        self.register_buffer("std", std.float())

    @classmethod
    def identity(cls, channels: int) -> "LatentNormalisation":
        """Mean 0 and std 1: to load a checkpoint into."""
        return cls(torch.zeros(channels), torch.ones(channels))

    @classmethod
    def measured(cls, latents: Iterable[SparseTensor]) -> "LatentNormalisation":
        """Over all voxels of the given latents, with the population's std; ModelError when there is none."""
        count, total, squares = 0, torch.zeros(()).double(), torch.zeros(()).double()
        for latent in latents:
            rows = latent.features.detach().cpu().double()
            count += len(rows)
            total = total + rows.sum(0)
            squares = squares + rows.square().sum(0)
        if count == 0:
            raise ModelError(
                "latent normalisation",
                "no voxel to measure",
                expected="latents of the training objects",
                action="Check the training split.",
            )
        mean = total / count
        return cls(mean, (squares / count - mean.square()).clamp(min=0).sqrt())

    def normalised(self, latent: SparseTensor) -> SparseTensor:
        """What the flow learns on; float32."""
        return latent.with_features((latent.features.float() - self.mean) / self.std)

    def restored(self, latent: SparseTensor) -> SparseTensor:
        """The way back, for the decoders; float32."""
        return latent.with_features(latent.features.float() * self.std + self.mean)


def require_layout(where: str, x: SparseTensor, *, channels: int, resolution: int) -> None:
    """ModelError when a sparse tensor has other channels or another resolution than a network was made for."""
    found = (x.features.shape[1], x.grid.resolution)
    if found != (channels, resolution):
        raise ModelError(
            where,
            f"{found[0]} channels at {found[1]}^3",
            expected=f"{channels} channels at {resolution}^3",
            action="Use features and networks of one configuration.",
        )
