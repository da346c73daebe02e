"""The modulated diffusion-transformer block of TRELLIS (FORMATS 4.1), with grouped tokens and weighted sources."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from model.networks.attention import CrossAttention, SelfAttention

__all__ = [
    "FeedForward",
    "ModulatedCrossBlock",
    "initialise_head",
    "initialise_transformer",
    "layer_norm",
    "run_block",
]


def layer_norm(x: Float[Tensor, "*batch channel"], eps: float = 1e-6) -> Float[Tensor, "*batch channel"]:
    """Layer norm without parameters over the last axis, in float32."""
    return nn.functional.layer_norm(x.float(), x.shape[-1:], eps=eps).to(x.dtype)


class FeedForward(nn.Module):
    """Linear, tanh-GELU, Linear; parameters mlp.0 and mlp.2."""

    def __init__(self, channels: int, mlp_ratio: int) -> None:
        super().__init__()
        hidden = channels * mlp_ratio
        self.mlp = nn.Sequential(
            nn.Linear(channels, hidden), nn.GELU(approximate="tanh"), nn.Linear(hidden, channels)
        )

    def forward(self, x: Float[Tensor, "*batch channel"]) -> Float[Tensor, "*batch channel"]:
        """Same shape as x."""
        return self.mlp(x)


class ModulatedCrossBlock(nn.Module):
    """x + gate attn(adaLN x); x + crossattn(LN x), not modulated and not gated; x + gate MLP(adaLN x).

    Tokens come in groups: self-attention stays within a group. The geometry branch has one group, the mask
    branch one group per view, so all views share these weights and no parameter knows a view's place.
    """

    def __init__(self, *, channels: int, context_channels: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        self.norm2 = nn.LayerNorm(channels, eps=1e-6)
        self.self_attn = SelfAttention(channels, heads)
        self.cross_attn = CrossAttention(channels, context_channels, heads)
        self.mlp = FeedForward(channels, mlp_ratio)
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(channels, 6 * channels))

    def forward(
        self,
        x: Float[Tensor, "batch group token channel"],
        t_embedding: Float[Tensor, "batch channel"],
        contexts: Float[Tensor, "batch source key context"],
        weights: Float[Tensor, "batch source"],
    ) -> Float[Tensor, "batch group token channel"]:
        """One block; `weights` sum to one over the sources (Eq. 1)."""
        groups = x.shape[1]
        modulation = self.adaLN_modulation(t_embedding)[:, None, None].chunk(6, dim=-1)
        shift_attn, scale_attn, gate_attn, shift_mlp, scale_mlp, gate_mlp = modulation
        h = layer_norm(x) * (1 + scale_attn) + shift_attn
        x = x + gate_attn * self.self_attn(h.flatten(0, 1)).unflatten(0, (-1, groups))
        # Queries of all groups in one sequence: the keys and values of a sample are computed and kept once.
        x = x + self.cross_attn(self.norm2(x).flatten(1, 2), contexts, weights).unflatten(1, (groups, -1))
        h = layer_norm(x) * (1 + scale_mlp) + shift_mlp
        return x + gate_mlp * self.mlp(h)


def run_block(block: nn.Module, *inputs: Any, recompute: bool) -> Any:
    """The block's output; `recompute` keeps nothing of it for the backward pass: less memory, more time."""
    if recompute and torch.is_grad_enabled():
        # Nothing random inside a block (no dropout), so its RNG state need not be kept.
        return checkpoint(block, *inputs, use_reentrant=False, preserve_rng_state=False)
    return block(*inputs)


def initialise_transformer(network: nn.Module, *, t_embedder: nn.Module | None) -> None:
    """TRELLIS's initialisation of all but the head; for dense and sparse networks.

    Linear layers Xavier-uniform with zero bias, the time MLP N(0, 0.02²), adaLN zero (self-attention and MLP
    start gated off; cross-attention is ungated and starts on). Convolutions stay as their blocks drew them.
    """
    for module in network.modules():
        if isinstance(module, nn.Linear):
            nn.init.xavier_uniform_(module.weight)
            nn.init.zeros_(module.bias)
    for module in t_embedder.modules() if t_embedder is not None else ():
        if isinstance(module, nn.Linear):
            nn.init.normal_(module.weight, std=0.02)
    for module in network.modules():
        modulation = getattr(module, "adaLN_modulation", None)
        if modulation is not None:
            nn.init.zeros_(modulation[1].weight)


def initialise_head(out_layer: nn.Linear) -> None:
    """A tenth of Xavier's gain, where TRELLIS has zero.

    With a zero head no gradient would leave it in the first step; this keeps the first prediction near zero and lets
    the loss reach everything behind it from the first step.
    """
    nn.init.xavier_uniform_(out_layer.weight, gain=0.1)
    nn.init.zeros_(out_layer.bias)
