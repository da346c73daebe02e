"""Resampling and blocks against dense counterparts, and their parameters against the published ones."""

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool3d, conv3d, group_norm, interpolate, silu

from model.errors import ModelError
from model.networks.sparse.blocks import SparseGroupNorm, SparseResBlock3d, SparseSubdivideBlock3d
from model.networks.sparse.convolution import SparseConv3d
from model.networks.sparse.resampling import mean_pool, subdivide, unpool
from model.networks.sparse.sequences import Window
from model.networks.sparse.tensor import SparseTensor
from model.networks.sparse.transformer import (
    ModulatedSparseCrossBlock,
    SparseTransformerBlock,
    shifted_windows,
)
from model.networks.transformer import ModulatedCrossBlock, initialise_transformer
from tests.model.networks.sparse.dense import from_dense, from_samples, occupancy_of, to_dense


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def _tensor(fraction: float, channels: int = 8, resolution: int = 6) -> SparseTensor:
    occupancy = torch.rand(2, *[resolution] * 3) < fraction
    x = from_dense(torch.randn(2, channels, *[resolution] * 3), occupancy)
    return x.with_features(x.features.requires_grad_())


def _awake(block: nn.Module) -> nn.Module:
    """Parameters that start at zero would hide what they multiply."""
    for parameter in block.parameters():
        if not parameter.any():
            nn.init.normal_(parameter, std=0.2)
    return block


def _close(ours: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(ours, expected, atol=1e-5, rtol=1e-5)


def _same_gradients(x: SparseTensor, ours: Tensor, expected: Tensor) -> None:
    upstream = torch.randn_like(ours)
    grads = [torch.autograd.grad((out * upstream).sum(), x.features) for out in (ours, expected)]
    torch.testing.assert_close(*grads, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("fraction", [1.0, 0.3, 0.01])
@pytest.mark.parametrize("factor", [2, 3])
def test_mean_pool_and_back_are_the_dense_operations(fraction: float, factor: int) -> None:
    x = _tensor(fraction)
    occupancy = occupancy_of(x.grid)
    count = avg_pool3d(occupancy.float()[:, None], factor) * factor**3
    dense = avg_pool3d(to_dense(x), factor) * factor**3 / count.clamp(min=1)
    pooled = mean_pool(x, factor, pseudo_count=0)
    _close(to_dense(pooled), dense)
    assert torch.equal(occupancy_of(pooled.grid), count[:, 0] > 0)

    ours = unpool(pooled, x.grid)
    assert ours.grid is x.grid
    expected = interpolate(dense, scale_factor=factor) * occupancy[:, None]
    _close(to_dense(ours), expected)
    _same_gradients(x, to_dense(ours), expected)


def test_published_pooling_counts_a_zero_more() -> None:
    """scatter_reduce "mean" into zeros with include_self, as the published flow was trained."""
    x = _tensor(0.4)
    coarsening = x.grid.coarsened(2)
    index = coarsening.parent[:, None].expand_as(x.features)
    expected = torch.zeros(coarsening.coarse.voxels, 8).scatter_reduce(0, index, x.features, "mean")
    _close(mean_pool(x, 2, pseudo_count=1).features, expected)


def test_unpool_refuses_another_grid() -> None:
    x = _tensor(0.3)
    other = mean_pool(_tensor(0.3), 2, pseudo_count=0)
    with pytest.raises(ModelError, match=r"voxels at 3\^3 are not the cells of"):
        unpool(other, x.grid)


@pytest.mark.parametrize("fraction", [1.0, 0.3, 0.01])
def test_group_norm_is_that_of_each_sample(fraction: float) -> None:
    norm, x = SparseGroupNorm(4, 8), _tensor(fraction)
    for parameter in norm.parameters():
        nn.init.normal_(parameter)
    parts = [rows.T[None] for rows in x.features.split(x.grid.sample_sizes)]
    normed = [
        group_norm(part, 4, norm.weight, norm.bias)[0].T if part.numel() else part[0].T for part in parts
    ]
    _close(norm(x).features, torch.cat(normed))
    _same_gradients(x, norm(x).features, torch.cat(normed))


def _dense_conv(layer: SparseConv3d, x: Tensor, occupancy: Tensor) -> Tensor:
    weight = layer.conv.weight.permute(0, 4, 1, 2, 3)
    return conv3d(x, weight, layer.conv.bias, padding=layer.kernel // 2) * occupancy[:, None]


def _per_voxel(layer: nn.Module, x: Tensor) -> Tensor:
    return layer(x.movedim(1, -1)).movedim(-1, 1)


@pytest.mark.parametrize("fraction", [1.0, 0.3])
@pytest.mark.parametrize("out_channels", [8, 12])
def test_residual_block_is_the_dense_one(fraction: float, out_channels: int) -> None:
    block, x = _awake(SparseResBlock3d(8, out_channels, 5)), _tensor(fraction)
    t_embedding, occupancy = torch.randn(2, 5), occupancy_of(x.grid)
    scale, shift = block.emb_layers(t_embedding)[:, :, None, None, None].chunk(2, dim=1)
    h = silu(_per_voxel(block.norm1, to_dense(x))) * occupancy[:, None]
    h = _dense_conv(block.conv1, h, occupancy)
    h = _per_voxel(lambda y: nn.functional.layer_norm(y, y.shape[-1:], eps=1e-6), h)
    h = silu(h * (1 + scale) + shift) * occupancy[:, None]
    expected = _dense_conv(block.conv2, h, occupancy) + _per_voxel(block.skip_connection, to_dense(x))
    ours = block(x, t_embedding)
    _close(ours.features, from_dense(expected, occupancy).features)
    _same_gradients(x, ours.features, from_dense(expected, occupancy).features)


@pytest.mark.parametrize("out_channels", [8, 4])
def test_subdivide_block_is_the_dense_one_on_full_grids(out_channels: int) -> None:
    block, x = _awake(SparseSubdivideBlock3d(8, out_channels, 2)), _tensor(1.0, resolution=4)
    norm_in, norm_out = block.act_layers[0], block.out_layers[1]
    first, last = block.out_layers[0], block.out_layers[3]
    everywhere = torch.ones(2, 8, 8, 8, dtype=torch.bool)
    up = interpolate(silu(group_norm(to_dense(x), 2, norm_in.weight, norm_in.bias)), scale_factor=2)
    h = group_norm(_dense_conv(first, up, everywhere), 2, norm_out.weight, norm_out.bias)
    h = _dense_conv(last, silu(h), everywhere)
    skip = interpolate(to_dense(x), scale_factor=2)
    if isinstance(block.skip_connection, SparseConv3d):
        skip = _dense_conv(block.skip_connection, skip, everywhere)
    ours = to_dense(block(x))
    _close(ours, h + skip)
    _same_gradients(x, ours, h + skip)


def test_subdivide_gives_the_children_the_features() -> None:
    x = _tensor(0.3)
    _close(to_dense(subdivide(x)), interpolate(to_dense(x), scale_factor=2))


def test_blocks_start_as_their_skip() -> None:
    x = _tensor(0.3)
    torch.testing.assert_close(SparseResBlock3d(8, 8, 5)(x, torch.randn(2, 5)).features, x.features)
    torch.testing.assert_close(SparseSubdivideBlock3d(8, 8, 2)(x).features, subdivide(x).features)


def _modulated(window: Window | None = None) -> ModulatedSparseCrossBlock:
    return ModulatedSparseCrossBlock(channels=12, context_channels=7, heads=3, mlp_ratio=2, window=window)


def test_modulated_block_is_the_dense_one_on_full_grids() -> None:
    """With the same parameters, by the same names."""
    x, contexts, weights = _tensor(1.0, channels=12), torch.randn(2, 3, 5, 7), torch.rand(2, 3).softmax(-1)
    dense = ModulatedCrossBlock(channels=12, context_channels=7, heads=3, mlp_ratio=2)
    sparse, t_embedding = _modulated(), torch.randn(2, 12)
    sparse.load_state_dict(dense.state_dict())
    expected = dense(x.features.unflatten(0, (2, 1, -1)), t_embedding, contexts, weights).flatten(0, 2)
    ours = sparse(x, t_embedding, contexts, weights).features
    _close(ours, expected)
    _same_gradients(x, ours, expected)


@pytest.mark.parametrize("window", [None, Window(size=4, shift=2)])
def test_modulated_block_treats_each_sample_alone(window: Window | None) -> None:
    x, contexts, weights = _tensor(0.3, channels=12), torch.randn(2, 3, 5, 7), torch.rand(2, 3).softmax(-1)
    block, t_embedding = _modulated(window), torch.randn(2, 12)
    together = block(x, t_embedding, contexts, weights).features
    alone = []
    for sample in range(2):
        rows = x.grid.batch_index == sample
        one = from_samples([x.features[rows]], [x.grid.coordinates[rows]], 6)
        at = slice(sample, sample + 1)
        alone.append(block(one, t_embedding[at], contexts[at], weights[at]).features)
    _close(together, torch.cat(alone))


def test_equal_views_count_as_one() -> None:
    x, context, block = _tensor(0.3, channels=12), torch.randn(2, 1, 5, 7), _modulated()
    one = block(x, torch.zeros(2, 12), context, torch.ones(2, 1)).features
    many = block(x, torch.zeros(2, 12), context.expand(-1, 4, -1, -1), torch.rand(2, 4).softmax(-1))
    _close(many.features, one)


def test_a_stack_of_blocks_takes_empty_samples() -> None:
    occupancy = torch.zeros(2, 4, 4, 4, dtype=torch.bool)
    for _ in range(2):
        x = from_dense(torch.randn(2, 12, 4, 4, 4), occupancy)
        h = SparseTransformerBlock(channels=12, heads=3, mlp_ratio=2, window=Window(size=2, shift=1))(x)
        h = _modulated()(h, torch.randn(2, 12), torch.randn(2, 3, 5, 7), torch.full((2, 3), 1 / 3))
        h = unpool(mean_pool(h, 2, pseudo_count=1), h.grid)
        h = SparseSubdivideBlock3d(12, 4, 2)(SparseResBlock3d(12, 12, 5)(h, torch.randn(2, 5)))
        assert h.features.shape == (8 * x.grid.voxels, 4)
        assert h.features.isfinite().all()
        occupancy[1, 0, 1, 2] = True


def test_windows_shift_in_every_other_block() -> None:
    assert [window.shift for window in shifted_windows(8, 4)] == [0, 4, 0, 4]


def test_modulation_starts_closed() -> None:
    block = _modulated()
    initialise_transformer(block, t_embedder=None)
    assert not block.adaLN_modulation[1].weight.any()
    assert block.self_attn.to_qkv.weight.any()


# As the published files have them: slat_flow_img_dit_L_64l8p2, slat_enc_swin8_B_64l8, slat_dec_mesh_swin8_B_64l8m256c.
_FLOW_BLOCK = {
    "norm2.weight": [1024],
    "norm2.bias": [1024],
    "self_attn.to_qkv.weight": [3072, 1024],
    "self_attn.to_qkv.bias": [3072],
    "self_attn.q_rms_norm.gamma": [16, 64],
    "self_attn.k_rms_norm.gamma": [16, 64],
    "self_attn.to_out.weight": [1024, 1024],
    "self_attn.to_out.bias": [1024],
    "cross_attn.to_q.weight": [1024, 1024],
    "cross_attn.to_q.bias": [1024],
    "cross_attn.to_kv.weight": [2048, 1024],
    "cross_attn.to_kv.bias": [2048],
    "cross_attn.to_out.weight": [1024, 1024],
    "cross_attn.to_out.bias": [1024],
    "mlp.mlp.0.weight": [4096, 1024],
    "mlp.mlp.0.bias": [4096],
    "mlp.mlp.2.weight": [1024, 4096],
    "mlp.mlp.2.bias": [1024],
    "adaLN_modulation.1.weight": [6144, 1024],
    "adaLN_modulation.1.bias": [6144],
}
_VAE_BLOCK = {
    "attn.to_qkv.weight": [2304, 768],
    "attn.to_qkv.bias": [2304],
    "attn.to_out.weight": [768, 768],
    "attn.to_out.bias": [768],
    "mlp.mlp.0.weight": [3072, 768],
    "mlp.mlp.0.bias": [3072],
    "mlp.mlp.2.weight": [768, 3072],
    "mlp.mlp.2.bias": [768],
}
_RESIDUAL_BLOCK = {
    "norm1.weight": [256],
    "norm1.bias": [256],
    "conv1.conv.weight": [128, 3, 3, 3, 256],
    "conv1.conv.bias": [128],
    "conv2.conv.weight": [128, 3, 3, 3, 128],
    "conv2.conv.bias": [128],
    "emb_layers.1.weight": [256, 1024],
    "emb_layers.1.bias": [256],
    "skip_connection.weight": [128, 256],
    "skip_connection.bias": [128],
}
_SUBDIVIDE_BLOCK = {
    "act_layers.0.weight": [192],
    "act_layers.0.bias": [192],
    "out_layers.0.conv.weight": [96, 3, 3, 3, 192],
    "out_layers.0.conv.bias": [96],
    "out_layers.1.weight": [96],
    "out_layers.1.bias": [96],
    "out_layers.3.conv.weight": [96, 3, 3, 3, 96],
    "out_layers.3.conv.bias": [96],
    "skip_connection.conv.weight": [96, 1, 1, 1, 192],
    "skip_connection.conv.bias": [96],
}


def test_names_and_shapes_are_the_published_ones() -> None:
    with torch.device("meta"):
        blocks = [
            ModulatedSparseCrossBlock(
                channels=1024, context_channels=1024, heads=16, mlp_ratio=4, window=None
            ),
            SparseTransformerBlock(channels=768, heads=12, mlp_ratio=4, window=Window(size=8, shift=0)),
            SparseResBlock3d(256, 128, 1024),
            SparseSubdivideBlock3d(192, 96, 32),
        ]
    shapes = [{name: list(value.shape) for name, value in block.state_dict().items()} for block in blocks]
    assert shapes == [_FLOW_BLOCK, _VAE_BLOCK, _RESIDUAL_BLOCK, _SUBDIVIDE_BLOCK]
