"""Decoder of structured latents: the surface (FORMATS 4.1).

With the `paper` values of `SlatVaeConfig` it has the parameters of slat_dec_mesh_swin8_B_64l8m256c.
"""

import math
from itertools import pairwise

from torch import nn

from model.networks.sparse.blocks import SparseSubdivideBlock3d
from model.networks.sparse.tensor import SparseTensor
from model.networks.transformer import initialise_head, initialise_transformer
from model.structured_latent.vae.latent import SlatVaeConfig, require_layout
from model.structured_latent.vae.trunk import run_trunk, trunk_blocks
from model.surface.fields import CHANNELS

__all__ = ["SurfaceDecoder"]

_GROUPS = 32  # of the published group norms; narrower networks have as many of them as divide their widths


class SurfaceDecoder(nn.Module):
    """Latents to the 101 channels of `model.surface.fields`, on a grid 2 ** len(upsample) times as fine."""

    def __init__(self, config: SlatVaeConfig) -> None:
        super().__init__()
        self.config = config
        self.input_layer = nn.Linear(config.latent_channels, config.channels)
        self.blocks = trunk_blocks(config)
        widths = (config.channels, *config.upsample)
        self.upsample = nn.ModuleList(
            SparseSubdivideBlock3d(wide, narrow, math.gcd(_GROUPS, wide, narrow))
            for wide, narrow in pairwise(widths)
        )
        self.out_layer = nn.Linear(widths[-1], CHANNELS)
        initialise_transformer(self, t_embedder=None)
        initialise_head(self.out_layer)

    def forward(self, latent: SparseTensor) -> SparseTensor:
        """Each voxel becomes 8 ** len(upsample); ModelError for other channels or another resolution."""
        config = self.config
        require_layout(
            "surface decoder", latent, channels=config.latent_channels, resolution=config.resolution
        )
        h = run_trunk(latent, self.input_layer, self.blocks)
        for block in self.upsample:
            h = block(h)
        return h.map(self.out_layer)
