"""SLat flow: its dense counterpart, symmetry over views, independence, gradients, precision, adapters."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d, conv3d, interpolate, layer_norm, silu

from model.errors import ModelError
from model.flow import preconditioned_velocity
from model.networks.embeddings import sincos_position_embedding
from model.networks.lora import LoraSettings, add_lora, export_adapter, merge_lora
from model.networks.sparse.blocks import SparseResBlock3d
from model.networks.transformer import ModulatedCrossBlock
from model.structured_latent.flow import SlatFlow, SlatFlowConfig
from tests.model.networks.adapters import paper_adapters, read_by_peft, trainable_parameters
from tests.model.networks.sparse.dense import from_dense, from_samples, to_dense
from tests.model.structured_latent.small_slat import (
    FLOW,
    PAPER_FLOW,
    TWO_LEVELS,
    one_sample,
    trained,
    voxels,
    without_gradient,
)


def _condition(views: int, batch: int = 2) -> tuple[Tensor, Tensor, Tensor]:
    """t, contexts and weights."""
    generator = torch.Generator().manual_seed(5)
    contexts = torch.randn(batch, views, 5, 12, generator=generator, dtype=torch.float64)
    weights = torch.rand(batch, views, generator=generator, dtype=torch.float64)
    t = torch.rand(batch, generator=generator, dtype=torch.float64)
    return t, contexts, weights / weights.sum(1, keepdim=True)


def _flow(config: SlatFlowConfig = FLOW) -> SlatFlow:
    torch.manual_seed(0)
    flow = trained(SlatFlow(config))
    assert isinstance(flow, SlatFlow)
    return flow


def _dense_residual(block: SparseResBlock3d, x: Tensor, t_embedding: Tensor) -> Tensor:
    def last(layer: object, y: Tensor) -> Tensor:
        return layer(y.movedim(1, -1)).movedim(-1, 1)  # type: ignore[operator]

    def conv(layer: object, y: Tensor) -> Tensor:
        return conv3d(y, layer.conv.weight.permute(0, 4, 1, 2, 3), layer.conv.bias, padding=1)  # type: ignore[attr-defined]

    scale, shift = block.emb_layers(t_embedding)[:, :, None, None, None].chunk(2, dim=1)
    h = conv(block.conv1, silu(last(block.norm1, x)))
    h = last(lambda y: layer_norm(y, y.shape[-1:], eps=1e-6), h) * (1 + scale) + shift
    return conv(block.conv2, silu(h)) + last(block.skip_connection, x)


def _dense_transformer(flow: SlatFlow, x: Tensor, embedding: Tensor, *condition: Tensor) -> Tensor:
    config, side = flow.config, x.shape[-1]
    tokens = x.flatten(2).transpose(1, 2) + sincos_position_embedding(side, 3, config.channels)
    for sparse in flow.blocks:
        block = ModulatedCrossBlock(
            channels=config.channels,
            context_channels=config.condition_channels,
            heads=config.heads,
            mlp_ratio=config.mlp_ratio,
        ).double()
        block.load_state_dict(sparse.state_dict())
        tokens = block(tokens[:, None], embedding, *condition)[:, 0]
    return tokens.transpose(1, 2).unflatten(2, (side, side, side))


def _dense_flow(flow: SlatFlow, x: Tensor, t: Tensor, *condition: Tensor) -> Tensor:
    """The published network written down for volumes, [batch channel i j k]."""
    embedding, levels = flow.t_embedder(t), len(flow.config.io_channels)
    h, skips = flow.input_layer(x.movedim(1, -1)).movedim(-1, 1), []
    for level in range(levels):
        fine = _dense_residual(flow.input_blocks[2 * level], h, embedding)
        pooled = avg_pool3d(fine, 2) * 8 / (8 + flow.config.pool_pseudo_count)
        h = _dense_residual(flow.input_blocks[2 * level + 1], pooled, embedding)
        skips.append((fine, h))
    h = _dense_transformer(flow, h, embedding, *condition)
    for level in range(levels):
        fine, coarse = skips.pop()
        h = interpolate(torch.cat([h, coarse], dim=1), scale_factor=2)
        h = _dense_residual(flow.out_blocks[2 * level], h, embedding)
        h = _dense_residual(flow.out_blocks[2 * level + 1], torch.cat([h, fine], dim=1), embedding)
    rows = h.movedim(1, -1)
    return flow.out_layer(layer_norm(rows, rows.shape[-1:])).movedim(-1, 1)


@pytest.mark.parametrize("config", [FLOW, TWO_LEVELS, replace(FLOW, patch=1, io_channels=())])
@pytest.mark.parametrize("pseudo_count", [0, 1])
def test_full_grids_give_the_dense_network(config: SlatFlowConfig, pseudo_count: int) -> None:
    flow = _flow(replace(config, pool_pseudo_count=pseudo_count))
    x, condition = voxels(1.0, 4), _condition(3)
    expected = _dense_flow(flow, to_dense(x), *condition)
    # Layer norms and positions are float32 by design.
    torch.testing.assert_close(to_dense(flow(x, *condition)), expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("config", [FLOW, TWO_LEVELS, replace(FLOW, patch=1, io_channels=())])
@pytest.mark.parametrize("views", [1, 6])
def test_velocities_are_on_the_grid_of_the_latents(config: SlatFlowConfig, views: int) -> None:
    x = voxels(0.2, 4)
    out = _flow(config)(x, *_condition(views))
    assert out.grid is x.grid
    assert out.features.shape == x.features.shape


def test_identical_views_equal_one_view() -> None:
    flow, x = _flow(), voxels(0.2, 4)
    t, contexts, _ = _condition(1)
    one = flow(x, t, contexts, torch.ones(2, 1).double())
    weights = torch.tensor([[0.5, 0.2, 0.3], [0.1, 0.1, 0.8]]).double()
    three = flow(x, t, contexts.expand(-1, 3, -1, -1), weights)
    torch.testing.assert_close(three.features, one.features)


def test_order_of_views_does_not_matter() -> None:
    flow, x, order = _flow(), voxels(0.2, 4), [2, 0, 3, 1]
    t, contexts, weights = _condition(4)
    permuted = flow(x, t, contexts[:, order], weights[:, order])
    torch.testing.assert_close(permuted.features, flow(x, t, contexts, weights).features)


def test_a_view_of_weight_zero_is_not_there() -> None:
    flow, x = _flow(), voxels(0.2, 4)
    t, contexts, _ = _condition(2)
    two = flow(x, t, contexts, torch.tensor([[1.0, 0.0]] * 2).double())
    one = flow(x, t, contexts[:, :1], torch.ones(2, 1).double())
    torch.testing.assert_close(two.features, one.features)


def test_order_of_voxels_does_not_matter() -> None:
    flow, x, condition = _flow(TWO_LEVELS), voxels(0.2, 4, batch=1), _condition(2, batch=1)
    order = torch.randperm(x.grid.voxels, generator=torch.Generator().manual_seed(0))
    shuffled = from_samples([x.features[order]], [x.grid.coordinates[order]], 8)
    torch.testing.assert_close(flow(shuffled, *condition).features, flow(x, *condition).features)


@pytest.mark.parametrize("config", [FLOW, TWO_LEVELS])
def test_each_sample_is_alone(config: SlatFlowConfig) -> None:
    flow, x, condition = _flow(config), voxels(0.2, 4), _condition(3)
    alone = [flow(one_sample(x, i), *[part[i : i + 1] for part in condition]).features for i in range(2)]
    torch.testing.assert_close(flow(x, *condition).features, torch.cat(alone), atol=1e-6, rtol=1e-6)


def test_empty_samples_are_allowed() -> None:
    occupancy = torch.zeros(2, 8, 8, 8, dtype=torch.bool)
    occupancy[1, 3, 3, 3] = True
    x = from_dense(torch.ones(2, 4, 8, 8, 8).double(), occupancy)
    assert _flow()(x, *_condition(2)).features.isfinite().all()


@pytest.mark.parametrize("config", [FLOW, TWO_LEVELS])
def test_gradients_reach_every_parameter_and_every_view(config: SlatFlowConfig) -> None:
    flow = _flow(config)
    t, contexts, weights = (part.requires_grad_() for part in _condition(3))
    x = voxels(0.2, 4)
    flow(x, t, contexts, weights).features.square().mean().backward()
    assert without_gradient(flow) == []
    assert contexts.grad is not None
    assert contexts.grad.flatten(2).any(2).all()
    assert weights.grad is not None
    assert weights.grad.all()


def test_the_first_step_reaches_the_condition() -> None:
    torch.manual_seed(0)
    flow = SlatFlow(FLOW).double()
    t, contexts, weights = _condition(2)
    out = flow(voxels(0.2, 4), t, contexts.requires_grad_(), weights)
    assert out.features.square().mean().sqrt() < 0.5
    (out.features - 1).square().mean().backward()
    assert contexts.grad is not None
    assert contexts.grad.any()


def test_checkpointing_changes_nothing() -> None:
    x, condition, found = voxels(0.2, 4), _condition(2), []
    for checkpointed in (False, True):
        flow = _flow(replace(FLOW, checkpoint_blocks=checkpointed))
        flow(x, *condition).features.square().mean().backward()
        found.append([parameter.grad for parameter in flow.parameters()])
    assert all(torch.equal(a, b) for a, b in zip(*found))


@pytest.mark.parametrize("whole", [False, True])
def test_bfloat16_stays_close(whole: bool) -> None:
    """Under autocast, and with all parameters in bfloat16."""
    flow, x = _flow().float(), voxels(0.2, 4)
    t, contexts, weights = (part.float() for part in _condition(3))
    x = x.with_features(x.features.float())
    exact = flow(x, t, contexts, weights).features
    if whole:
        flow = flow.bfloat16()
        found = flow(x.with_features(x.features.bfloat16()), t, contexts.bfloat16(), weights).features
        assert found.dtype == torch.bfloat16
    else:
        with torch.autocast("cpu", torch.bfloat16):
            found = flow(x, t, contexts, weights).features
    assert (found.float() - exact).norm() < 0.04 * exact.norm()


def test_wrong_sizes_are_one_line() -> None:
    with pytest.raises(ModelError, match=r"patch 2, io_channels \(8, 8\)"):
        replace(FLOW, io_channels=(8, 8))
    with pytest.raises(ModelError, match="7 heads do not divide 24 channels"):
        replace(FLOW, heads=7)
    t, contexts, weights = _condition(2)
    with pytest.raises(ModelError, match=r"x_t: 3 channels at 8\^3; expected 4 channels at 8\^3"):
        _flow()(voxels(0.2, 3), t, contexts, weights)
    with pytest.raises(ModelError, match="contexts of 5 channels"):
        _flow()(voxels(0.2, 4), t, contexts[..., :5], weights)


LORA = LoraSettings(rank=3, alpha=6, dropout=0.0)


def test_paper_adapters_are_those_of_stage_one() -> None:
    """Rank 64 on every projection of every attention of the published size, and nothing else."""
    with torch.device("meta"):
        flow = SlatFlow(PAPER_FLOW)
        add_lora(flow, LoraSettings(rank=64, alpha=128, dropout=0.0))
    assert trainable_parameters(flow) == paper_adapters()


def test_adapters_start_without_effect_train_merge_and_travel(tmp_path: Path) -> None:
    flow, x, condition = _flow().float(), voxels(0.2, 4), [part.float() for part in _condition(2)]
    x = x.with_features(x.features.float())
    before, names = flow(x, *condition).features, set(flow.state_dict())
    add_lora(flow, LORA)
    assert torch.equal(flow(x, *condition).features, before)

    for name, parameter in flow.named_parameters():
        if "lora_B" in name:
            torch.nn.init.normal_(parameter, std=0.3)
    adapted = flow(x, *condition).features
    assert not torch.allclose(adapted, before)
    adapted.square().mean().backward()
    silent = {name for name in without_gradient(flow) if "lora" in name}
    assert silent == set()

    export_adapter(flow, tmp_path)
    other = read_by_peft(_flow().float(), tmp_path)
    assert torch.equal(other(x, *condition).features, adapted)
    merge_lora(flow)
    assert set(flow.state_dict()) == names
    torch.testing.assert_close(flow(x, *condition).features, adapted, atol=1e-4, rtol=1e-4)


def test_a_preconditioned_flow_adds_what_the_noise_tells() -> None:
    plain = trained(SlatFlow(FLOW))
    fitted = SlatFlow(replace(FLOW, preconditioned=True)).to(torch.float64)
    fitted.load_state_dict(plain.state_dict())
    x_t, (t, contexts, weights) = voxels(0.2, 4), _condition(views=2)
    output = plain(x_t, t, contexts, weights)
    found = fitted(x_t, t, contexts, weights)
    expected = preconditioned_velocity(x_t.features, output.features, t[x_t.grid.batch_index])
    torch.testing.assert_close(found.features, expected)
