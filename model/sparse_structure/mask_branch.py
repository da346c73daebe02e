"""Mask branch: a diffusion transformer over the tokens of each view, pixel-aligned with its image features.

New in the paper (section 3.2), so trained from scratch. All views share its weights, and nothing marks a
view's place: permuting views permutes masks.
"""

from dataclasses import dataclass
from typing import Annotated

from jaxtyping import Float
from torch import Tensor, nn

from model.errors import ModelError
from model.flow import binary_velocity
from model.networks.attention import require_heads
from model.networks.embeddings import TimestepEmbedder, sincos_position_embedding
from model.networks.patches import patchify, unpatchify
from model.networks.transformer import (
    ModulatedCrossBlock,
    initialise_head,
    initialise_transformer,
    layer_norm,
)
from shards.settings import Range

__all__ = ["MaskBranch", "MaskBranchConfig"]


@dataclass(frozen=True, kw_only=True)
class MaskBranchConfig:
    """Sizes: grid x grid tokens, each over patch x patch pixels of the mask; `blocks` is the paper's P."""

    feature_channels: Annotated[int, Range(1, 65_536)]
    grid: Annotated[int, Range(1, 65_536)]
    patch: Annotated[int, Range(1, 65_536)]
    channels: Annotated[int, Range(1, 65_536)]
    blocks: Annotated[int, Range(1, 65_536)]
    heads: Annotated[int, Range(1, 65_536)]
    mlp_ratio: Annotated[int, Range(1, 65_536)]

    def __post_init__(self) -> None:
        require_heads("mask branch", self.channels, self.heads)

    @property
    def mask_resolution(self) -> int:
        """Pixels per side of a mask."""
        return self.grid * self.patch


class MaskBranch(nn.Module):
    """Embedding, blocks and head; `DualBranchFlow` runs the blocks, in step with the geometry branch."""

    pos_emb: Tensor

    def __init__(self, config: MaskBranchConfig, geometry_channels: int) -> None:
        super().__init__()
        self.config = config
        self.t_embedder = TimestepEmbedder(config.channels)
        # Computed, not learned, and in no published file: not saved.
        pos_emb = sincos_position_embedding(config.grid, 2, config.channels)
        self.register_buffer("pos_emb", pos_emb, persistent=False)
        self.feature_layer = nn.Linear(config.feature_channels, config.channels)
        self.input_layer = nn.Linear(config.patch**2, config.channels)
        self.blocks = nn.ModuleList(
            ModulatedCrossBlock(
                channels=config.channels,
                context_channels=geometry_channels,
                heads=config.heads,
                mlp_ratio=config.mlp_ratio,
            )
            for _ in range(config.blocks)
        )
        self.out_layer = nn.Linear(config.channels, config.patch**2)
        initialise_transformer(self, t_embedder=self.t_embedder)
        initialise_head(self.out_layer)

    def embed(
        self, masks_t: Float[Tensor, "batch view 1 m m"], features: Float[Tensor, "batch view token feature"]
    ) -> Float[Tensor, "batch view token channel"]:
        """Tokens x_1^n: projected features + embedded noisy mask + position; ModelError for other sizes."""
        side, tokens = self.config.mask_resolution, self.config.grid**2
        found = (tuple(masks_t.shape[-2:]), *features.shape[2:])
        expected = ((side, side), tokens, self.config.feature_channels)
        if found != expected:
            raise ModelError(
                "masks_t and features",
                f"mask size, tokens, feature channels {found}",
                expected=str(expected),
                action="Match grid, patch and feature_channels of the mask branch to the encoder.",
            )
        patches = patchify(masks_t.flatten(0, 1), self.config.patch).unflatten(0, masks_t.shape[:2])
        return self.feature_layer(features) + self.input_layer(patches) + self.pos_emb

    def read_out(
        self,
        tokens: Float[Tensor, "batch view token channel"],
        masks_t: Float[Tensor, "batch view 1 m m"],
        t: Float[Tensor, " batch"],
    ) -> Float[Tensor, "batch view 1 m m"]:
        """Velocity of every mask: the head on x_{P+1} gives half the log-odds of object at every pixel."""
        patches = self.out_layer(layer_norm(tokens, eps=1e-5))
        side = self.config.mask_resolution
        half_log_odds = unpatchify(patches.flatten(0, 1), self.config.patch, (side, side))
        return binary_velocity(masks_t, half_log_odds.unflatten(0, tokens.shape[:2]), t)
