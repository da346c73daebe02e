"""Geometry branch: a diffusion transformer over the patched latent of the occupancy grid.

With the `paper` values (FORMATS 4.1: latent 16, 8 channels, patch 1, 1024 channels, 24 blocks, 16 heads,
mlp 4, condition 1024) names and shapes of its parameters are those of ss_flow_img_dit_L_16l8.
"""

from dataclasses import dataclass
from typing import Annotated

from jaxtyping import Float
from torch import Tensor, nn

from model.errors import ModelError
from model.flow import preconditioned_velocity
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

__all__ = ["GeometryBranch", "GeometryBranchConfig"]


@dataclass(frozen=True, kw_only=True)
class GeometryBranchConfig:
    """Sizes. The latent grid is cut into patches of `patch` cells per axis; `blocks` is the paper's M.

    `preconditioned`: the head gives what `preconditioned_velocity` lacks, which small networks learn sooner;
    false: the head gives the velocity itself, as in published weights.
    """

    latent_resolution: Annotated[int, Range(1, 65_536)]
    latent_channels: Annotated[int, Range(1, 65_536)]
    patch: Annotated[int, Range(1, 65_536)]
    channels: Annotated[int, Range(1, 65_536)]
    condition_channels: Annotated[int, Range(1, 65_536)]
    blocks: Annotated[int, Range(1, 65_536)]
    heads: Annotated[int, Range(1, 65_536)]
    mlp_ratio: Annotated[int, Range(1, 65_536)]
    preconditioned: bool

    def __post_init__(self) -> None:
        require_heads("geometry branch", self.channels, self.heads)
        if self.latent_resolution % self.patch:
            raise ModelError(
                "geometry branch",
                f"patch {self.patch} does not divide latent_resolution {self.latent_resolution}",
                expected="latent_resolution % patch == 0",
                action="Change one of them.",
            )

    @property
    def latent_shape(self) -> tuple[int, int, int, int]:
        """Channels and grid of one latent."""
        return (self.latent_channels, *[self.latent_resolution] * 3)  # type: ignore[return-value]

    @property
    def tokens(self) -> int:
        """Geometry tokens of one sample."""
        return (self.latent_resolution // self.patch) ** 3


class GeometryBranch(nn.Module):
    """Embedding, blocks and head; `DualBranchFlow` runs the blocks, in step with the mask branch."""

    pos_emb: Tensor

    def __init__(self, config: GeometryBranchConfig) -> None:
        super().__init__()
        self.config = config
        patch_channels = config.latent_channels * config.patch**3
        self.t_embedder = TimestepEmbedder(config.channels)
        side = config.latent_resolution // config.patch
        self.register_buffer("pos_emb", sincos_position_embedding(side, 3, config.channels))
        self.input_layer = nn.Linear(patch_channels, config.channels)
        self.blocks = nn.ModuleList(
            ModulatedCrossBlock(
                channels=config.channels,
                context_channels=config.condition_channels,
                heads=config.heads,
                mlp_ratio=config.mlp_ratio,
            )
            for _ in range(config.blocks)
        )
        self.out_layer = nn.Linear(config.channels, patch_channels)
        initialise_transformer(self, t_embedder=self.t_embedder)
        initialise_head(self.out_layer)

    def embed(self, x_t: Float[Tensor, "batch latent i j k"]) -> Float[Tensor, "batch 1 token channel"]:
        """Tokens y_1 of a noisy latent; ModelError for a latent of another shape."""
        if x_t.shape[1:] != self.config.latent_shape:
            raise ModelError(
                "x_t",
                f"latent shape {tuple(x_t.shape[1:])}",
                expected=str(self.config.latent_shape),
                action="Use the VAE that belongs to this config.",
            )
        tokens = self.input_layer(patchify(x_t, self.config.patch)) + self.pos_emb
        return tokens[:, None]

    def read_out(
        self,
        tokens: Float[Tensor, "batch 1 token channel"],
        x_t: Float[Tensor, "batch latent i j k"],
        t: Float[Tensor, " batch"],
    ) -> Float[Tensor, "batch latent i j k"]:
        """Velocity of the latent from y_{M+1}."""
        patches = self.out_layer(layer_norm(tokens[:, 0], eps=1e-5))
        output = unpatchify(patches, self.config.patch, self.config.latent_shape[1:]).to(x_t.dtype)
        return preconditioned_velocity(x_t, output, t) if self.config.preconditioned else output
