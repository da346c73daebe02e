"""Dual-branch flow of stage 1: geometry and amodal masks denoised together (section 3.2, Eq. 1).

Per layer, from the same pair (y_j, x_i):

    y_{j+1} = GeometryBlock_j(y_j; sum_n w_n CrossAttn(Q(y_j), K(x_i^n), V(x_i^n)))
    x_{i+1} = MaskBlock_i(x_i; CrossAttn(Q(x_i), K(y_j), V(y_j)))

where the blocks also hold the self-attention and MLP of a diffusion transformer (FORMATS 4.1), and the geometry
attends to x_i^n through `MaskContext`.

configs/model/paper.yaml has the values of the paper.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from model.errors import ModelError
from model.networks.transformer import layer_norm, run_block
from model.networks.view_fusion import MaskContext, ViewFusion
from model.sparse_structure.geometry_branch import GeometryBranch, GeometryBranchConfig
from model.sparse_structure.mask_branch import MaskBranch, MaskBranchConfig

__all__ = ["DualBranchConfig", "DualBranchFlow", "DualCondition", "DualVelocity", "mask_block_schedule"]


@dataclass(frozen=True, kw_only=True)
class DualBranchConfig:
    """Both branches. `checkpoint_blocks` recomputes each layer in the backward pass: less memory, more time."""

    geometry: GeometryBranchConfig
    masks: MaskBranchConfig
    checkpoint_blocks: bool

    def __post_init__(self) -> None:
        if not 1 <= self.masks.blocks <= self.geometry.blocks:
            raise ModelError(
                "dual branch",
                f"{self.masks.blocks} mask blocks and {self.geometry.blocks} geometry blocks",
                expected="1 <= mask blocks <= geometry blocks (P <= M)",
                action="Lower masks.blocks.",
            )


def mask_block_schedule(geometry_blocks: int, mask_blocks: int) -> tuple[int | None, ...]:
    """For each geometry block, the mask block that runs beside it, or None.

    Mask block i runs beside geometry block floor(i M / P): evenly spread, from the first. The geometry blocks
    between two mask blocks use the deepest mask tokens there are.
    """
    beside = {i * geometry_blocks // mask_blocks: i for i in range(mask_blocks)}
    return tuple(beside.get(j) for j in range(geometry_blocks))


@dataclass(frozen=True, kw_only=True)
class DualCondition:
    """What the flow knows of the views."""

    features: Float[
        Tensor, "batch view token feature"
    ]  # of images and hands, aggregated: for the mask branch
    images: (
        Float[Tensor, "batch view token condition"] | None
    )  # layer-normed: for the geometry, beside mask tokens

    def dropped(self, samples: Bool[Tensor, " batch"]) -> "DualCondition":
        """Without condition for these samples: zeros, as TRELLIS's neg_cond (FORMATS 4.4)."""
        drop = samples[:, None, None, None]
        return DualCondition(
            features=torch.where(drop, 0, self.features),
            images=None if self.images is None else torch.where(drop, 0, self.images),
        )

    def unconditional(self) -> "DualCondition":
        """No sample with condition, for guidance."""
        return self.dropped(self.features.new_ones(len(self.features), dtype=torch.bool))


@dataclass(frozen=True, kw_only=True)
class DualVelocity:
    """Velocities (noise - clean) of the latent and of every view's mask."""

    geometry: Float[Tensor, "batch latent i j k"]
    masks: Float[Tensor, "batch view 1 m m"]


class DualBranchFlow(nn.Module):
    """Velocity of latent and masks, given noisy latent, noisy masks, one time and a condition.

    `geometry.*` are the parameters of a published flow; `masks.*`, `fusion.*` and `context.*` are new.
    `image_context`: conditions bring `images`, and until training changes it the geometry sees nothing else.
    """

    def __init__(self, config: DualBranchConfig, *, image_context: bool = False) -> None:
        super().__init__()
        self.config = config
        self.geometry = GeometryBranch(config.geometry)
        self.masks = MaskBranch(config.masks, config.geometry.channels)
        self.fusion = ViewFusion(config.masks.channels)
        self.context = MaskContext(
            config.masks.channels, config.geometry.condition_channels, starts_at_zero=image_context
        )
        self._schedule = mask_block_schedule(config.geometry.blocks, config.masks.blocks)

    def forward(
        self,
        x_t: Float[Tensor, "batch latent i j k"],
        masks_t: Float[Tensor, "batch view 1 m m"],
        t: Float[Tensor, " batch"],
        condition: DualCondition,
    ) -> DualVelocity:
        """One t per sample for both branches (Eq. 2); masks are in {-1, +1} when clean.

        ModelError when a size does not fit the config.
        """
        y, x = self.geometry.embed(x_t), self.masks.embed(masks_t, condition.features)
        t_geometry, t_masks = self.geometry.t_embedder(t), self.masks.t_embedder(t)
        weights = self.fusion(x)
        contexts, recompute = self.context(x, condition.images), self.config.checkpoint_blocks
        for block, i in zip(self.geometry.blocks, self._schedule, strict=True):
            y_next = run_block(block, y, t_geometry, contexts, weights, recompute=recompute)
            if i is not None:
                x = run_block(self.masks.blocks[i], x, t_masks, *_single_source(y), recompute=recompute)
                contexts = self.context(x, condition.images)
            y = y_next
        return DualVelocity(
            geometry=self.geometry.read_out(y, x_t, t), masks=self.masks.read_out(x, masks_t, t)
        )


def _single_source(y: Tensor) -> tuple[Tensor, Tensor]:
    """Geometry tokens as the one context of the mask branch, normed because the residual stream grows."""
    return layer_norm(y), y.new_ones(y.shape[0], 1)
