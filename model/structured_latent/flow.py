"""SLat flow: a diffusion transformer over the latents of the occupied voxels, conditioned per view (section 3.3).

With the values of slat_flow_img_dit_L_64l8p2 (resolution 64, latent 8, channels 1024, condition 1024, 24 blocks,
16 heads, mlp 4, patch 2, io_channels (128,), pool_pseudo_count 1) names and shapes of its parameters are those.

    x_t at R^3 -> two residual blocks per level of io_channels, the second after pooling by 2 -> blocks at (R / patch)^3
        -> the residual blocks mirrored, each reading what its counterpart gave -> velocity at R^3
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor, nn

from model.errors import ModelError
from model.flow import preconditioned_velocity
from model.networks.attention import require_heads
from model.networks.embeddings import TimestepEmbedder
from model.networks.sparse.blocks import SparseResBlock3d
from model.networks.sparse.resampling import mean_pool, unpool
from model.networks.sparse.tensor import SparseTensor
from model.networks.sparse.transformer import ModulatedSparseCrossBlock
from model.networks.transformer import initialise_head, initialise_transformer, layer_norm, run_block
from model.structured_latent.vae.latent import require_layout
from model.structured_latent.vae.trunk import embedded
from shards.settings import Range

__all__ = ["SlatFlow", "SlatFlowConfig"]


@dataclass(frozen=True, kw_only=True)
class SlatFlowConfig:
    """Sizes. `patch` = 2 ** len(io_channels): each level of residual blocks halves the resolution.

    `pool_pseudo_count`: 1 for weights that began as TRELLIS's, else 0 (`mean_pool`). `checkpoint_blocks`
    recomputes each transformer block in the backward pass: less memory, more time. `preconditioned`: the head gives
    what `preconditioned_velocity` lacks, which small networks learn sooner; false for published weights.
    """

    resolution: Annotated[int, Range(1, 65_536)]
    latent_channels: Annotated[int, Range(1, 65_536)]
    channels: Annotated[int, Range(1, 65_536)]
    condition_channels: Annotated[int, Range(1, 65_536)]
    blocks: Annotated[int, Range(1, 65_536)]
    heads: Annotated[int, Range(1, 65_536)]
    mlp_ratio: Annotated[int, Range(1, 65_536)]
    patch: Annotated[int, Range(1, 65_536)]
    io_channels: Annotated[tuple[int, ...], Range(1, 65_536)]
    pool_pseudo_count: Annotated[int, Range(0, 1_000_000)]
    checkpoint_blocks: bool
    preconditioned: bool

    def __post_init__(self) -> None:
        require_heads("slat flow", self.channels, self.heads)
        if self.patch != 2 ** len(self.io_channels) or self.resolution % self.patch:
            raise ModelError(
                "slat flow",
                f"patch {self.patch}, io_channels {self.io_channels}, resolution {self.resolution}",
                expected="patch == 2 ** len(io_channels), and it divides the resolution",
                action="Give io_channels one width for each halving.",
            )


class SlatFlow(nn.Module):
    """Velocity of noisy latents."""

    def __init__(self, config: SlatFlowConfig) -> None:
        super().__init__()
        self.config = config
        widths = (*config.io_channels, config.channels)
        self.t_embedder = TimestepEmbedder(config.channels)
        self.input_layer = nn.Linear(config.latent_channels, widths[0])
        self.input_blocks = nn.ModuleList()
        self.out_blocks = nn.ModuleList()
        for fine, coarse in pairwise(widths):
            self.input_blocks.append(SparseResBlock3d(fine, fine, config.channels))
            self.input_blocks.append(SparseResBlock3d(fine, coarse, config.channels))
        for coarse, fine in pairwise(reversed(widths)):
            # Twice the width: what comes from the blocks beside what the mirrored input block gave.
            self.out_blocks.append(SparseResBlock3d(2 * coarse, fine, config.channels))
            self.out_blocks.append(SparseResBlock3d(2 * fine, fine, config.channels))
        self.blocks = nn.ModuleList(
            ModulatedSparseCrossBlock(
                channels=config.channels,
                context_channels=config.condition_channels,
                heads=config.heads,
                mlp_ratio=config.mlp_ratio,
                window=None,
            )
            for _ in range(config.blocks)
        )
        self.out_layer = nn.Linear(widths[0], config.latent_channels)
        initialise_transformer(self, t_embedder=self.t_embedder)
        initialise_head(self.out_layer)

    def forward(
        self,
        x_t: SparseTensor,
        t: Float[Tensor, " batch"],
        contexts: Float[Tensor, "batch view token condition"],
        weights: Float[Tensor, "batch view"],
    ) -> SparseTensor:
        """noise - clean on the grid of x_t; `weights` of a sample sum to one over its views (Eq. 1).

        ModelError when a size does not fit the config.
        """
        self._check(x_t, contexts)
        t_embedding = self.t_embedder(t)
        h = x_t.map(self.input_layer)
        skips: list[SparseTensor] = []
        for level in range(len(self.config.io_channels)):
            skips.append(self.input_blocks[2 * level](h if not skips else skips[-1], t_embedding))
            pooled = mean_pool(skips[-1], 2, pseudo_count=self.config.pool_pseudo_count)
            skips.append(self.input_blocks[2 * level + 1](pooled, t_embedding))
        h = embedded(skips[-1] if skips else h, self.input_layer)
        for block in self.blocks:
            h = run_block(block, h, t_embedding, contexts, weights, recompute=self.config.checkpoint_blocks)
        for i, block in enumerate(self.out_blocks):
            h = _beside(h, skips.pop())
            # The first block of a level reads the coarse grid and works on the fine one.
            h = block(unpool(h, skips[-1].grid) if i % 2 == 0 else h, t_embedding)
        output = self.out_layer(layer_norm(h.features, eps=1e-5))
        if self.config.preconditioned:
            output = preconditioned_velocity(
                x_t.features, output.to(x_t.features.dtype), t[h.grid.batch_index]
            )
        return h.with_features(output)

    def _check(self, x_t: SparseTensor, contexts: Tensor) -> None:
        config = self.config
        require_layout("x_t", x_t, channels=config.latent_channels, resolution=config.resolution)
        if contexts.shape[-1] != config.condition_channels:
            raise ModelError(
                "slat flow",
                f"contexts of {contexts.shape[-1]} channels",
                expected=f"{config.condition_channels}",
                action="Match condition_channels to what makes the contexts.",
            )


def _beside(x: SparseTensor, y: SparseTensor) -> SparseTensor:
    """Channels of both, on the grid they share."""
    return x.with_features(torch.cat([x.features, y.features], dim=1))
