"""Transformer blocks on voxels: the plain one of the SLat VAE and the modulated one of the SLat flow."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from model.networks.sparse.attention import SparseCrossAttention, SparseSelfAttention
from model.networks.sparse.sequences import Window
from model.networks.sparse.tensor import SparseTensor
from model.networks.transformer import FeedForward, layer_norm

__all__ = [
    "ModulatedSparseCrossBlock",
    "SparseTransformerBlock",
    "scale_and_shift",
    "shifted_windows",
]


class SparseTransformerBlock(nn.Module):
    """x + attn(LN x); x + MLP(LN x); norms without parameters, attention without norm on q and k."""

    def __init__(self, *, channels: int, heads: int, mlp_ratio: int, window: Window | None) -> None:
        super().__init__()
        self.attn = SparseSelfAttention(channels, heads, window=window, qk_rms_norm=False)
        self.mlp = FeedForward(channels, mlp_ratio)

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Same grid and channels."""
        x = _add(x, self.attn(x.map(layer_norm)))
        return _add(x, x.map(layer_norm).map(self.mlp))


class ModulatedSparseCrossBlock(nn.Module):
    """`ModulatedCrossBlock` on voxels: x + gate attn(adaLN x); x + crossattn(LN x); x + gate MLP(adaLN x)."""

    def __init__(
        self, *, channels: int, context_channels: int, heads: int, mlp_ratio: int, window: Window | None
    ) -> None:
        super().__init__()
        self.norm2 = nn.LayerNorm(channels, eps=1e-6)
        self.self_attn = SparseSelfAttention(channels, heads, window=window, qk_rms_norm=True)
        self.cross_attn = SparseCrossAttention(channels, context_channels, heads)
        self.mlp = FeedForward(channels, mlp_ratio)
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(channels, 6 * channels))

    def forward(
        self,
        x: SparseTensor,
        t_embedding: Float[Tensor, "batch channel"],
        contexts: Float[Tensor, "batch source key context"],
        weights: Float[Tensor, "batch source"],
    ) -> SparseTensor:
        """Same grid and channels; `weights` sum to one over the sources (Eq. 1)."""
        modulation = self.adaLN_modulation(t_embedding).chunk(6, dim=-1)
        shift_attn, scale_attn, gate_attn, shift_mlp, scale_mlp, gate_mlp = modulation
        h = self.self_attn(scale_and_shift(x.map(layer_norm), scale_attn, shift_attn))
        x = _add(x, _gated(h, gate_attn))
        x = _add(x, self.cross_attn(x.map(self.norm2), contexts, weights))
        h = scale_and_shift(x.map(layer_norm), scale_mlp, shift_mlp).map(self.mlp)
        return _add(x, _gated(h, gate_mlp))


def shifted_windows(size: int, blocks: int) -> tuple[Window, ...]:
    """Windows of successive blocks: every other one shifted by half a window, so neighbours across a border meet."""
    return tuple(Window(size=size, shift=size // 2 * (block % 2)) for block in range(blocks))


def scale_and_shift(
    x: SparseTensor, scale: Float[Tensor, "batch channel"], shift: Float[Tensor, "batch channel"]
) -> SparseTensor:
    """x (1 + scale) + shift with the values of each voxel's sample."""
    # Sample by sample: nothing of the size of the features is kept for the factors.
    rows = zip(x.features.split(x.grid.sample_sizes), scale, shift, strict=True)
    return x.with_features(torch.cat([part * (1 + factor) + offset for part, factor, offset in rows]))


def _gated(x: SparseTensor, gate: Float[Tensor, "batch channel"]) -> SparseTensor:
    rows = zip(x.features.split(x.grid.sample_sizes), gate, strict=True)
    return x.with_features(torch.cat([part * factor for part, factor in rows]))


def _add(x: SparseTensor, y: SparseTensor) -> SparseTensor:
    return x.with_features(x.features + y.features)
