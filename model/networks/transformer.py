"""The modulated diffusion-transformer block of TRELLIS (FORMATS 4.1), with grouped tokens and weighted sources."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from model.networks.attention import CrossAttention, SelfAttention

__all__ = ["FeedForward", "ModulatedCrossBlock", "initialise_transformer", "layer_norm"]


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


def initialise_transformer(branch: nn.Module, *, t_embedder: nn.Module, out_layer: nn.Linear) -> None:
    """TRELLIS's initialisation, except that the output layer is small instead of zero.

    Linear layers Xavier-uniform with zero bias, the time MLP N(0, 0.02²), adaLN zero (self-attention and MLP
    start gated off; cross-attention is ungated and starts on). With a zero output layer no gradient would
    leave the head in the first step; a tenth of Xavier's gain keeps the first prediction near zero and lets
    the joint loss reach both branches through the cross-attentions from the first step.
    """
    for module in branch.modules():
        if isinstance(module, nn.Linear):
            nn.init.xavier_uniform_(module.weight)
            nn.init.zeros_(module.bias)
    for module in t_embedder.modules():
        if isinstance(module, nn.Linear):
            nn.init.normal_(module.weight, std=0.02)
    for module in branch.modules():
        if isinstance(module, ModulatedCrossBlock):
            modulation = module.adaLN_modulation[1]
            assert isinstance(modulation, nn.Linear)
            nn.init.zeros_(modulation.weight)
    nn.init.xavier_uniform_(out_layer.weight, gain=0.1)
    with torch.no_grad():
        out_layer.bias.zero_()
