"""Layers against their formulas, written out with NumPy or plain torch (FORMATS 4.1)."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from model.networks.attention import CrossAttention, MultiHeadRMSNorm, SelfAttention
from model.networks.convolution import (
    ChannelLayerNorm,
    Downsample3d,
    ResidualBlock3d,
    Upsample3d,
    pixel_shuffle_3d,
    pixel_unshuffle_3d,
)
from model.networks.embeddings import TimestepEmbedder, sincos_position_embedding
from model.networks.patches import patchify, unpatchify
from model.networks.transformer import ModulatedCrossBlock


def test_rms_norm_has_unit_rms_times_gamma() -> None:
    norm = MultiHeadRMSNorm(8, 2)
    torch.nn.init.normal_(norm.gamma)
    x = torch.randn(2, 3, 2, 8)
    expected = x / x.square().mean(-1, keepdim=True).sqrt() * norm.gamma
    torch.testing.assert_close(norm(x), expected)


def _plain_attention(q: torch.Tensor, k: torch.Tensor, v: torch.Tensor, heads: int) -> torch.Tensor:
    """[token channel] each; heads are contiguous slices of the channels."""
    out = []
    for head in range(heads):
        cut = slice(head * q.shape[1] // heads, (head + 1) * q.shape[1] // heads)
        scores = q[:, cut] @ k[:, cut].T / math.sqrt(q.shape[1] // heads)
        out.append(scores.softmax(-1) @ v[:, cut])
    return torch.cat(out, dim=1)


def test_self_attention_is_its_formula() -> None:
    layer = SelfAttention(12, 3)
    for norm in (layer.q_rms_norm, layer.k_rms_norm):
        torch.nn.init.normal_(norm.gamma)
    x = torch.randn(1, 5, 12)
    q, k, v = layer.to_qkv(x)[0].split(12, dim=-1)
    q = layer.q_rms_norm(q.reshape(1, 5, 3, 4)).reshape(5, 12)
    k = layer.k_rms_norm(k.reshape(1, 5, 3, 4)).reshape(5, 12)
    torch.testing.assert_close(layer(x)[0], layer.to_out(_plain_attention(q, k, v, 3)))


def test_cross_attention_is_the_weighted_sum_of_eq_1() -> None:
    layer = CrossAttention(12, 7, 3)
    x, contexts, weights = torch.randn(2, 5, 12), torch.randn(2, 4, 6, 7), torch.rand(2, 4).softmax(-1)
    for sample in range(2):
        total = torch.zeros(5, 12)
        for n in range(4):
            k, v = layer.to_kv(contexts[sample, n]).split(12, dim=-1)
            one = layer.to_out(_plain_attention(layer.to_q(x[sample]), k, v, 3))  # to_out inside the sum
            total = total + weights[sample, n] * one
        torch.testing.assert_close(layer(x, contexts, weights)[sample], total, atol=1e-5, rtol=1e-5)


def test_position_embedding_is_trellis_formula() -> None:
    embedding = sincos_position_embedding(16, 3, 1024).numpy()
    assert embedding.shape == (4096, 1024)
    i, j, k = 3, 11, 7
    row = embedding[(i * 16 + j) * 16 + k]
    frequencies = 1 / 10_000 ** (np.arange(170) / 170)
    parts = [
        part for index in (i, j, k) for part in (np.sin(index * frequencies), np.cos(index * frequencies))
    ]
    np.testing.assert_allclose(row, np.concatenate([*parts, np.zeros(4)]), atol=1e-5)


def test_time_embedding_is_cosine_then_sine_of_1000_t() -> None:
    embedder = TimestepEmbedder(256)
    identity = torch.nn.Linear(256, 256)
    torch.nn.init.eye_(identity.weight)
    torch.nn.init.zeros_(identity.bias)
    embedder.mlp = torch.nn.Sequential(identity)
    t = 0.37
    frequencies = 10_000.0 ** (-np.arange(128) / 128)
    expected = np.concatenate([np.cos(1000 * t * frequencies), np.sin(1000 * t * frequencies)])
    np.testing.assert_allclose(embedder(torch.tensor([t])).detach().numpy()[0], expected, atol=1e-4)


def test_block_is_its_formula() -> None:
    block = ModulatedCrossBlock(channels=12, context_channels=7, heads=3, mlp_ratio=2)
    for parameter in block.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    x, t, context = torch.randn(2, 1, 5, 12), torch.randn(2, 12), torch.randn(2, 1, 6, 7)
    ones = torch.ones(2, 1)
    modulation = block.adaLN_modulation[1]
    assert isinstance(modulation, torch.nn.Linear)
    shift, scale, gate, shift2, scale2, gate2 = torch.nn.functional.linear(
        torch.nn.functional.silu(t), modulation.weight, modulation.bias
    )[:, None].split(12, -1)
    y = x[:, 0]
    h = torch.nn.functional.layer_norm(y, (12,), eps=1e-6) * (1 + scale) + shift
    y = y + gate * block.self_attn(h)
    h = torch.nn.functional.layer_norm(y, (12,), block.norm2.weight, block.norm2.bias, eps=1e-6)
    y = y + block.cross_attn(h, context, ones)
    h = torch.nn.functional.layer_norm(y, (12,), eps=1e-6) * (1 + scale2) + shift2
    first, second = block.mlp.mlp[0], block.mlp.mlp[2]
    y = y + gate2 * second(torch.nn.functional.gelu(first(h), approximate="tanh"))
    torch.testing.assert_close(block(x, t, context, ones)[:, 0], y)


def test_self_attention_of_a_block_stays_within_its_group() -> None:
    block = ModulatedCrossBlock(channels=12, context_channels=7, heads=3, mlp_ratio=2)
    torch.nn.init.normal_(block.get_parameter("adaLN_modulation.1.weight"))
    x, t, context, ones = (
        torch.randn(1, 3, 5, 12),
        torch.randn(1, 12),
        torch.randn(1, 1, 6, 7),
        torch.ones(1, 1),
    )
    together = block(x, t, context, ones)
    apart = torch.cat([block(x[:, n : n + 1], t, context, ones) for n in range(3)], dim=1)
    torch.testing.assert_close(together, apart)


@pytest.mark.parametrize(("grid", "patch"), [((4, 4), 2), ((4, 4, 4), 2), ((3, 3, 3), 1), ((8, 8), 4)])
def test_patches_round_trip(grid: tuple[int, ...], patch: int) -> None:
    x = torch.randn(2, 3, *grid)
    tokens = patchify(x, patch)
    assert tokens.shape == (2, math.prod(grid) // patch ** len(grid), 3 * patch ** len(grid))
    assert torch.equal(unpatchify(tokens, patch, grid), x)


def test_patch_order_is_channel_then_offset() -> None:
    x = torch.arange(2 * 4 * 4).reshape(1, 2, 4, 4).float()
    token = patchify(x, 2)[0, 1]  # rows 0-1, columns 2-3
    assert token.tolist() == [2, 3, 6, 7, 18, 19, 22, 23]


def test_pixel_shuffle_places_each_channel() -> None:
    x = torch.randn(1, 16, 2, 3, 4)
    fine = pixel_shuffle_3d(x, 2)
    assert fine.shape == (1, 2, 4, 6, 8)
    c, a, b, d = 1, 1, 0, 1
    assert fine[0, c, 2 * 1 + a, 2 * 2 + b, 2 * 3 + d] == x[0, c * 8 + a * 4 + b * 2 + d, 1, 2, 3]


def test_convolution_blocks() -> None:
    x = torch.randn(2, 4, 4, 6, 8)
    assert torch.equal(ResidualBlock3d(4)(x), x)  # identity at the start
    assert Downsample3d(4, 6)(x).shape == (2, 6, 2, 3, 4)
    assert Upsample3d(4, 6)(x).shape == (2, 6, 8, 12, 16)
    normed = ChannelLayerNorm(4)(x)
    expected = (x - x.mean(1, keepdim=True)) / (x.var(1, unbiased=False, keepdim=True) + 1e-5).sqrt()
    torch.testing.assert_close(normed, expected)


@given(factor=st.integers(1, 3), seed=st.integers(0, 100))
def test_pixel_unshuffle_undoes_pixel_shuffle(factor: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    fine = torch.randn(2, 3, 2 * factor, factor, 3 * factor, generator=generator)
    coarse = pixel_unshuffle_3d(fine, factor)
    assert coarse.shape == (2, 3 * factor**3, 2, 1, 3)
    assert torch.equal(pixel_shuffle_3d(coarse, factor), fine)
