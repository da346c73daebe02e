"""Attention on voxels against dense attention: the dense layers on full grids, masks over all rows on sparse ones."""

from collections.abc import Callable

import pytest
import torch
from torch.nn.functional import scaled_dot_product_attention

from model.networks.attention import CrossAttention, SelfAttention
from model.networks.sparse.attention import (
    SparseCrossAttention,
    SparseSelfAttention,
    attend_packed,
    attend_padded,
    attend_sequences,
)
from model.networks.sparse.backends import uses_packed_attention
from model.networks.sparse.grid import SparseGrid
from model.networks.sparse.sequences import Window
from model.networks.sparse.tensor import SparseTensor
from tests.model.networks.sparse.dense import from_dense

_WINDOWS = [None, Window(size=4, shift=0), Window(size=4, shift=2), Window(size=3, shift=1)]


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def _tensor(fraction: float, channels: int = 12) -> SparseTensor:
    occupancy = torch.rand(2, 8, 8, 8) < fraction
    return from_dense(torch.randn(2, channels, 8, 8, 8), occupancy)


def _sees(grid: SparseGrid, window: Window | None) -> torch.Tensor:
    """[row, row]: both in one sample and one window."""
    group = grid.batch_index[:, None]
    if window is not None:
        group = torch.cat([group, (grid.coordinates + window.shift) // window.size], dim=1)
    return (group[:, None] == group[None]).all(-1)


def _masked(layer: SparseSelfAttention, x: SparseTensor, features: torch.Tensor) -> torch.Tensor:
    q, k, v = layer.to_qkv(features)[None].unflatten(-1, (3, layer.heads, -1)).unbind(2)
    q, k = layer.q_rms_norm(q), layer.k_rms_norm(k)
    q, k, v = (part.transpose(1, 2) for part in (q, k, v))
    out = scaled_dot_product_attention(q, k, v, attn_mask=_sees(x.grid, layer.window))
    return layer.to_out(out.transpose(1, 2).flatten(2))[0]


@pytest.mark.parametrize("fraction", [1.0, 0.3, 0.01])
@pytest.mark.parametrize("window", _WINDOWS)
def test_self_attention_is_masked_attention(fraction: float, window: Window | None) -> None:
    layer = SparseSelfAttention(12, 3, window=window, qk_rms_norm=fraction < 1)
    x = _tensor(fraction)
    features = x.features.clone().requires_grad_()
    ours, dense = layer(x.with_features(features)).features, _masked(layer, x, features)
    torch.testing.assert_close(ours, dense, atol=1e-5, rtol=1e-5)

    upstream, wanted = torch.randn_like(dense), [features, *layer.parameters()]
    grads = torch.autograd.grad((ours * upstream).sum(), wanted)
    expected = torch.autograd.grad((dense * upstream).sum(), wanted)
    torch.testing.assert_close(grads[0], expected[0], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(grads[1:], expected[1:], atol=1e-4, rtol=1e-4)


def test_full_grids_are_the_dense_layers() -> None:
    """With the same parameters, by the same names."""
    x = _tensor(1.0)
    tokens = x.features.unflatten(0, (2, -1))
    sparse, dense = SparseSelfAttention(12, 3, window=None, qk_rms_norm=True), SelfAttention(12, 3)
    sparse.load_state_dict(dense.state_dict())
    torch.testing.assert_close(sparse(x).features, dense(tokens).flatten(0, 1), atol=1e-5, rtol=1e-5)

    sparse, dense = SparseCrossAttention(12, 7, 3), CrossAttention(12, 7, 3)
    sparse.load_state_dict(dense.state_dict())
    contexts, weights = torch.randn(2, 4, 6, 7), torch.rand(2, 4).softmax(-1)
    expected = dense(tokens, contexts, weights).flatten(0, 1)
    torch.testing.assert_close(sparse(x, contexts, weights).features, expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("fraction", [0.3, 0.01])
def test_cross_attention_is_that_of_each_sample(fraction: float) -> None:
    x, contexts, weights = _tensor(fraction), torch.randn(2, 4, 6, 7), torch.rand(2, 4).softmax(-1)
    sparse, dense = SparseCrossAttention(12, 7, 3), CrossAttention(12, 7, 3)
    sparse.load_state_dict(dense.state_dict())
    inputs = [tensor.requires_grad_() for tensor in (x.features, contexts, weights)]
    ours = sparse(x, contexts, weights).features
    parts = zip(x.features.split(x.grid.sample_sizes), contexts, weights, strict=True)
    expected = torch.cat([dense(rows[None], context[None], w[None])[0] for rows, context, w in parts])
    torch.testing.assert_close(ours, expected, atol=1e-5, rtol=1e-5)

    upstream = torch.randn_like(ours)
    grads = [torch.autograd.grad((out * upstream).sum(), inputs) for out in (ours, expected)]
    torch.testing.assert_close(*grads, atol=1e-4, rtol=1e-5)


def test_equal_views_count_as_one() -> None:
    layer, x, context = SparseCrossAttention(12, 7, 3), _tensor(0.3), torch.randn(2, 1, 6, 7)
    one = layer(x, context, torch.ones(2, 1)).features
    many = layer(x, context.expand(-1, 5, -1, -1), torch.rand(2, 5).softmax(-1)).features
    torch.testing.assert_close(many, one, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("window", _WINDOWS)
def test_samples_do_not_see_each_other(window: Window | None) -> None:
    layer = SparseSelfAttention(12, 3, window=window, qk_rms_norm=True)
    x = _tensor(0.3)
    first = x.grid.batch_index == 0
    features = torch.where(first[:, None], x.features, 100 * torch.randn_like(x.features))
    changed = layer(x.with_features(features)).features
    torch.testing.assert_close(changed[first], layer(x).features[first], atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("window", [None, Window(size=8, shift=4)])
def test_memory_grows_with_the_voxels(
    window: Window | None, shell: Callable[[int], SparseGrid], memory_of: Callable
) -> None:
    """4 times the voxels are 4 times the memory (not 16); nothing exceeds the q, k and v of all rows."""
    layer = SparseSelfAttention(64, 2, window=window, qk_rms_norm=True)
    few, many = (memory_of(layer, shell(resolution), channels=64) for resolution in (20, 40))
    growth = many.voxels / few.voxels
    assert 3.5 < growth < 4.5
    assert many.kept_for_gradient < 1.15 * growth * few.kept_for_gradient
    assert many.largest_tensor <= many.voxels * 3 * 64 * 4


def test_memory_of_cross_attention_grows_with_the_voxels(
    shell: Callable[[int], SparseGrid], memory_of: Callable
) -> None:
    layer = SparseCrossAttention(64, 7, 2)
    contexts, weights = torch.randn(1, 3, 50, 7), torch.full((1, 3), 1 / 3)
    few, many = (
        memory_of(lambda x: layer(x, contexts, weights), shell(resolution), channels=64)
        for resolution in (20, 40)
    )
    assert many.kept_for_gradient < 1.15 * many.voxels / few.voxels * few.kept_for_gradient
    assert many.largest_tensor <= many.voxels * 64 * 4


def test_the_pure_path_runs_without_a_gpu() -> None:
    assert not uses_packed_attention(torch.zeros(1, 1, 1, dtype=torch.bfloat16))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("window", _WINDOWS)
def test_packed_attention_gives_the_same_numbers(window: Window | None) -> None:
    grid = _tensor(0.3).grid.to(torch.device("cuda"))
    q, k, v = torch.randn(3, grid.voxels, 3, 32, device="cuda", dtype=torch.bfloat16)
    sequences = grid.samples if window is None else grid.windows(window)
    packed = attend_packed(q, k, v, sequences).float()
    exact = attend_sequences(q.float(), k.float(), v.float(), sequences)
    torch.testing.assert_close(packed, exact, atol=0.02, rtol=0.02)
    if window is not None:
        torch.testing.assert_close(attend_padded(q, k, v, sequences).float(), exact, atol=0.02, rtol=0.02)
