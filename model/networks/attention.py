"""Multi-head attention with the parameter names of TRELLIS: to_qkv, to_q, to_kv, to_out, q_rms_norm, k_rms_norm."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from model.errors import ModelError

__all__ = ["CrossAttention", "MultiHeadRMSNorm", "SelfAttention", "require_heads"]


def require_heads(where: str, channels: int, heads: int) -> None:
    """ModelError when the channels cannot be shared out evenly."""
    if channels % heads:
        raise ModelError(
            where,
            f"{heads} heads do not divide {channels} channels",
            expected="channels % heads == 0",
            action="Change one of them.",
        )


class MultiHeadRMSNorm(nn.Module):
    """x / |x| * gamma * sqrt(channels of a head), computed in float32 (FORMATS 4.1)."""

    def __init__(self, head_channels: int, heads: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(heads, head_channels))

    def forward(
        self, x: Float[Tensor, "batch token head channel"]
    ) -> Float[Tensor, "batch token head channel"]:
        """Same shape and dtype as x."""
        scale = self.gamma.float() * self.gamma.shape[-1] ** 0.5
        return (nn.functional.normalize(x.float(), dim=-1) * scale).to(x.dtype)


def _attend(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """softmax(q k / sqrt(channel)) v on [batch token head channel]; heads joined: [batch token head*channel]."""
    out = nn.functional.scaled_dot_product_attention(q.transpose(1, 2), k.transpose(1, 2), v.transpose(1, 2))
    return out.transpose(1, 2).flatten(2)


class SelfAttention(nn.Module):
    """Every token attends to every token of its own sequence; q and k are RMS-normed."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.to_qkv = nn.Linear(channels, 3 * channels)
        self.q_rms_norm = MultiHeadRMSNorm(channels // heads, heads)
        self.k_rms_norm = MultiHeadRMSNorm(channels // heads, heads)
        self.to_out = nn.Linear(channels, channels)

    def forward(self, x: Float[Tensor, "batch token channel"]) -> Float[Tensor, "batch token channel"]:
        """Same shape as x."""
        q, k, v = self.to_qkv(x).unflatten(-1, (3, self.heads, -1)).unbind(2)
        return self.to_out(_attend(self.q_rms_norm(q), self.k_rms_norm(k), v))


class CrossAttention(nn.Module):
    """Attention to several sources, summed with one weight per source (Eq. 1); no norm on q and k."""

    def __init__(self, channels: int, context_channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.to_q = nn.Linear(channels, channels)
        self.to_kv = nn.Linear(context_channels, 2 * channels)
        self.to_out = nn.Linear(channels, channels)

    def forward(
        self,
        x: Float[Tensor, "batch token channel"],
        contexts: Float[Tensor, "batch source key context"],
        weights: Float[Tensor, "batch source"],
    ) -> Float[Tensor, "batch token channel"]:
        """sum_n weights_n CrossAttn(Q(x), K(context_n), V(context_n)); the weights of a sample sum to one.

        Because they do, the affine `to_out` may come after the sum: it, and Q, are computed once for all
        sources. Sources are never concatenated: each has its own softmax, and an added source costs its keys
        and one attention output.
        """
        q = self.to_q(x).unflatten(-1, (self.heads, -1))
        keys, values = self.to_kv(contexts).unflatten(-1, (2, self.heads, -1)).unbind(3)
        scale = weights.to(q.dtype)[:, :, None, None]
        attended = [_attend(q, keys[:, n], values[:, n]) * scale[:, n] for n in range(contexts.shape[1])]
        # A running sum, so that autograd keeps only what it needs of each source.
        total = attended[0]
        for term in attended[1:]:
            total = total + term
        return self.to_out(total)
