"""Attention among the voxels of a window or a sample, and to the contexts of a sample; names as in TRELLIS."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from model.networks.attention import MultiHeadRMSNorm
from model.networks.sparse.backends import uses_packed_attention
from model.networks.sparse.sequences import Sequences, Window
from model.networks.sparse.tensor import SparseTensor

__all__ = [
    "SparseCrossAttention",
    "SparseSelfAttention",
    "attend_packed",
    "attend_padded",
    "attend_sequences",
]


class SparseSelfAttention(nn.Module):
    """Every voxel attends to those of its window, or of its whole sample where `window` is None."""

    def __init__(self, channels: int, heads: int, *, window: Window | None, qk_rms_norm: bool) -> None:
        super().__init__()
        self.heads = heads
        self.window = window
        self.to_qkv = nn.Linear(channels, 3 * channels)
        self.q_rms_norm = MultiHeadRMSNorm(channels // heads, heads) if qk_rms_norm else nn.Identity()
        self.k_rms_norm = MultiHeadRMSNorm(channels // heads, heads) if qk_rms_norm else nn.Identity()
        self.to_out = nn.Linear(channels, channels)

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Same grid and channels."""
        q, k, v = self.to_qkv(x.features)[None].unflatten(-1, (3, self.heads, -1)).unbind(2)
        q, k = self.q_rms_norm(q), self.k_rms_norm(k)
        sequences = x.grid.samples if self.window is None else x.grid.windows(self.window)
        attended = attend_sequences(q[0], k[0], v[0], sequences)
        return x.with_features(self.to_out(attended.flatten(1)))


class SparseCrossAttention(nn.Module):
    """Attention of the voxels of a sample to its sources, summed with one weight per source (Eq. 1)."""

    def __init__(self, channels: int, context_channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.to_q = nn.Linear(channels, channels)
        self.to_kv = nn.Linear(context_channels, 2 * channels)
        self.to_out = nn.Linear(channels, channels)

    def forward(
        self,
        x: SparseTensor,
        contexts: Float[Tensor, "batch source key context"],
        weights: Float[Tensor, "batch source"],
    ) -> SparseTensor:
        """sum_n weights_n CrossAttn(Q(x), K(context_n), V(context_n)); the weights of a sample sum to one.

        As in the dense `CrossAttention`: `to_out` after the sum, one softmax per source, a running sum.
        """
        q = self.to_q(x.features).unflatten(-1, (self.heads, -1))
        keys, values = self.to_kv(contexts).unflatten(-1, (2, self.heads, -1)).unbind(3)
        samples, scale = x.grid.samples, weights.to(q.dtype)
        total = torch.zeros_like(q)
        for n in range(contexts.shape[1]):
            attended = _attend_contexts(q, keys[:, n], values[:, n], samples)
            of_sample = zip(attended.split(samples.lengths), scale[:, n], strict=True)
            total = total + torch.cat([rows * weight for rows, weight in of_sample])
        return x.with_features(self.to_out(total.flatten(1)))


def attend_sequences(
    q: Float[Tensor, "row head channel"],
    k: Float[Tensor, "row head channel"],
    v: Float[Tensor, "row head channel"],
    sequences: Sequences,
) -> Float[Tensor, "row head channel"]:
    """softmax(q k / sqrt(channel)) v within each sequence."""
    if uses_packed_attention(q):
        return attend_packed(q, k, v, sequences)
    if sequences.rows is not None:
        return attend_padded(q, k, v, sequences)
    parts = [part.split(sequences.lengths) for part in (q, k, v)]
    return torch.cat([_attend(*rows) for rows in zip(*parts, strict=True)])


def attend_padded(
    q: Float[Tensor, "row head channel"],
    k: Float[Tensor, "row head channel"],
    v: Float[Tensor, "row head channel"],
    sequences: Sequences,
) -> Float[Tensor, "row head channel"]:
    """For many short sequences: those of similar length in one call, so nothing is larger than they are."""
    padded = sequences.padded
    q, k, v = (part.index_select(0, padded.row_of_place) for part in (q, k, v))
    sizes = [bucket.count * bucket.length for bucket in padded.buckets]
    out = []
    for bucket, *parts in zip(padded.buckets, q.split(sizes), k.split(sizes), v.split(sizes), strict=True):
        batch = (part.unflatten(0, (bucket.count, bucket.length)).transpose(1, 2) for part in parts)
        attended = nn.functional.scaled_dot_product_attention(*batch, attn_mask=bucket.mask)
        out.append(attended.transpose(1, 2).flatten(0, 1))
    return torch.cat(out).index_select(0, padded.place_of_row) if out else q


def attend_packed(
    q: Float[Tensor, "row head channel"],
    k: Float[Tensor, "row head channel"],
    v: Float[Tensor, "row head channel"],
    sequences: Sequences,
) -> Float[Tensor, "row head channel"]:
    """The same by one call of FlashAttention; see `uses_packed_attention`."""
    if sequences.rows is None:
        return _flash(q, k, v, sequences, sequences)
    q, k, v = (part.index_select(0, sequences.rows) for part in (q, k, v))
    return _flash(q, k, v, sequences, sequences).index_select(0, sequences.places)


def _attend_contexts(
    q: Float[Tensor, "row head channel"],
    k: Float[Tensor, "batch key head channel"],
    v: Float[Tensor, "batch key head channel"],
    samples: Sequences,
) -> Float[Tensor, "row head channel"]:
    if uses_packed_attention(q):
        keys = Sequences(rows=None, lengths=(k.shape[1],) * k.shape[0])
        return _flash(q, k.flatten(0, 1), v.flatten(0, 1), samples, keys)
    parts = zip(q.split(samples.lengths), k, v, strict=True)
    return torch.cat([_attend(q_rows, k_rows, v_rows) for q_rows, k_rows, v_rows in parts])


def _attend(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """One sequence, [row head channel]."""
    q, k, v = (part.transpose(0, 1)[None] for part in (q, k, v))
    return nn.functional.scaled_dot_product_attention(q, k, v)[0].transpose(0, 1)


def _flash(q: Tensor, k: Tensor, v: Tensor, queries: Sequences, keys: Sequences) -> Tensor:
    from torch.nn.attention.varlen import varlen_attn

    if len(q) == 0:
        return q
    starts_q, starts_k = queries.offsets(q.device), keys.offsets(k.device)
    attended = varlen_attn(q, k, v, starts_q, starts_k, max(queries.lengths), max(keys.lengths))
    assert isinstance(attended, Tensor)  # a tuple only when auxiliary outputs are asked for
    return attended
