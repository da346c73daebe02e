"""SLat encoder: features of the occupied voxels to a latent per voxel (FORMATS 4.1).

With the `paper` values of `SlatVaeConfig` it has the parameters of slat_enc_swin8_B_64l8.
"""

from torch import nn

from model.networks.sparse.tensor import SparseTensor
from model.networks.transformer import initialise_head, initialise_transformer, layer_norm
from model.structured_latent.vae.latent import SlatDistribution, SlatVaeConfig, require_layout
from model.structured_latent.vae.trunk import run_trunk, trunk_blocks

__all__ = ["SlatEncoder"]


class SlatEncoder(nn.Module):
    """Voxel features to the distribution of their latents."""

    def __init__(self, config: SlatVaeConfig) -> None:
        super().__init__()
        self.config = config
        self.input_layer = nn.Linear(config.feature_channels, config.channels)
        self.blocks = trunk_blocks(config)
        self.out_layer = nn.Linear(config.channels, 2 * config.latent_channels)
        initialise_transformer(self, t_embedder=None)
        initialise_head(self.out_layer)

    def forward(self, features: SparseTensor) -> SlatDistribution:
        """Mean and logvar on the grid of the features; ModelError for other channels or another resolution."""
        config = self.config
        require_layout(
            "slat encoder", features, channels=config.feature_channels, resolution=config.resolution
        )
        h = run_trunk(features, self.input_layer, self.blocks)
        mean, logvar = self.out_layer(layer_norm(h.features, eps=1e-5)).chunk(2, dim=1)
        return SlatDistribution(mean=h.with_features(mean), logvar=h.with_features(logvar))
