"""Encoder and surface decoder: a dense counterpart, independence, precision, memory, and their heads."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import layer_norm, linear, scaled_dot_product_attention

from model.errors import ModelError
from model.networks.embeddings import sincos_position_embedding
from model.networks.sparse.grid import SparseGrid
from model.networks.sparse.resampling import subdivide
from model.networks.sparse.tensor import SparseTensor
from model.structured_latent.vae.decoder import SurfaceDecoder
from model.structured_latent.vae.encoder import SlatEncoder
from model.structured_latent.vae.latent import SlatVaeConfig
from model.surface.fields import CHANNELS, split_channels
from tests.model.networks.sparse.dense import from_dense, from_samples
from tests.model.structured_latent.small_slat import VAE, one_sample, trained, voxels, without_gradient

NETWORKS: list[tuple[Callable[[SlatVaeConfig], nn.Module], int]] = [
    (SlatEncoder, VAE.feature_channels),
    (SurfaceDecoder, VAE.latent_channels),
]


def _features(out: Any) -> Tensor:
    """All outputs of a network of the VAE in one tensor."""
    if isinstance(out, SparseTensor):
        return out.features
    return torch.cat([out.mean.features, out.logvar.features], dim=1)


def _dense_trunk(network: nn.Module, x: SparseTensor, config: SlatVaeConfig) -> Tensor:
    """The trunk for one sample as attention among all voxels, masked to those of the same window."""
    coordinates, channels = x.grid.coordinates, config.channels
    table = sincos_position_embedding(config.resolution, 3, channels).view(*[config.resolution] * 3, channels)
    h = network.input_layer(x.features) + table[tuple(coordinates.T)]
    for i, block in enumerate(network.blocks):
        window = (coordinates + i % 2 * (config.window // 2)) // config.window
        same = (window[:, None] == window[None]).all(-1)
        normed = layer_norm(h, (channels,), eps=1e-6)
        qkv = linear(normed, block.attn.to_qkv.weight, block.attn.to_qkv.bias)
        q, k, v = qkv.view(len(h), 3, config.heads, -1).permute(1, 2, 0, 3)
        attended = scaled_dot_product_attention(q, k, v, attn_mask=same).transpose(0, 1).flatten(1)
        h = h + block.attn.to_out(attended)
        h = h + block.mlp(layer_norm(h, (channels,), eps=1e-6))
    return h


@pytest.mark.parametrize("fraction", [1.0, 0.2])
def test_encoder_is_masked_dense_attention(fraction: float) -> None:
    encoder, x = trained(SlatEncoder(VAE)), voxels(fraction, VAE.feature_channels, batch=1)
    h = _dense_trunk(encoder, x, VAE)
    mean, logvar = encoder.out_layer(layer_norm(h, (VAE.channels,))).chunk(2, dim=1)
    found = encoder(x)
    # Layer norms and positions are float32 by design.
    torch.testing.assert_close(found.mean.features, mean, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(found.logvar.features, logvar, atol=1e-5, rtol=1e-5)
    assert found.mean.grid is x.grid


def test_surface_decoder_is_masked_dense_attention() -> None:
    x = voxels(0.3, VAE.latent_channels, batch=1)
    flat = replace(VAE, upsample=())
    surface = trained(SurfaceDecoder(flat))
    expected = surface.out_layer(_dense_trunk(surface, x, flat))
    torch.testing.assert_close(surface(x).features, expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("upsample", [(), (16,), (16, 8)])
def test_surface_decoder_divides_every_voxel(upsample: tuple[int, ...]) -> None:
    config = replace(VAE, upsample=upsample)
    x = voxels(0.1, VAE.latent_channels)
    out = trained(SurfaceDecoder(config))(x)
    children = x.with_features(torch.zeros(x.grid.voxels, 1))
    for _ in upsample:
        children = subdivide(children)
    assert out.grid.resolution == config.resolution * 2 ** len(upsample)
    assert torch.equal(out.grid.keys, children.grid.keys)
    assert out.features.shape[1] == CHANNELS
    split_channels(out.features, out.grid.resolution)


@pytest.mark.parametrize(("build", "channels"), NETWORKS)
def test_each_sample_is_alone(build: Callable[[SlatVaeConfig], nn.Module], channels: int) -> None:
    network, x = trained(build(VAE)), voxels(0.2, channels)
    alone = torch.cat([_features(network(one_sample(x, i))) for i in range(2)])
    torch.testing.assert_close(_features(network(x)), alone, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize(("build", "channels"), NETWORKS)
def test_order_of_voxels_does_not_matter(build: Callable[[SlatVaeConfig], nn.Module], channels: int) -> None:
    network, x = trained(build(VAE)), voxels(0.2, channels, batch=1)
    order = torch.randperm(x.grid.voxels, generator=torch.Generator().manual_seed(0))
    shuffled = from_samples([x.features[order]], [x.grid.coordinates[order]], 8)
    torch.testing.assert_close(_features(network(shuffled)), _features(network(x)))


@pytest.mark.parametrize(("build", "channels"), NETWORKS)
def test_gradients_reach_every_parameter(build: Callable[[SlatVaeConfig], nn.Module], channels: int) -> None:
    network, x = trained(build(VAE)), voxels(0.2, channels)
    _features(network(x)).square().mean().backward()
    assert without_gradient(network) == []


@pytest.mark.parametrize(("build", "channels"), NETWORKS)
def test_heads_start_small_and_let_the_gradient_through(
    build: Callable[[SlatVaeConfig], nn.Module], channels: int
) -> None:
    torch.manual_seed(0)
    network, x = build(VAE).double(), voxels(0.2, channels)
    out = _features(network(x))
    assert 0 < out.square().mean().sqrt() < 0.5
    out.square().mean().backward()
    assert network.input_layer.weight.grad.any()


@pytest.mark.parametrize(("build", "channels"), NETWORKS)
@pytest.mark.parametrize("whole", [False, True])
def test_bfloat16_stays_close(
    build: Callable[[SlatVaeConfig], nn.Module], channels: int, whole: bool
) -> None:
    """Under autocast, and with all parameters in bfloat16."""
    network, x = trained(build(VAE)).float(), voxels(0.2, channels)
    x = x.with_features(x.features.float())
    exact = _features(network(x))
    if whole:
        found = _features(network.bfloat16()(x.with_features(x.features.bfloat16())))
        assert found.dtype == torch.bfloat16
    else:
        with torch.autocast("cpu", torch.bfloat16):
            found = _features(network(x))
    assert (found.float() - exact).norm() < 0.04 * exact.norm()


@pytest.mark.parametrize(("build", "channels"), NETWORKS)
def test_empty_samples_are_allowed(build: Callable[[SlatVaeConfig], nn.Module], channels: int) -> None:
    network, occupancy = trained(build(VAE)), torch.zeros(2, 8, 8, 8, dtype=torch.bool)
    nothing = network(from_dense(torch.zeros(2, channels, 8, 8, 8).double(), occupancy))
    assert len(_features(nothing)) == 0
    occupancy[1, 0, 1, 2] = True
    out = network(from_dense(torch.ones(2, channels, 8, 8, 8).double(), occupancy))
    assert _features(out).isfinite().all()


def test_wrong_inputs_are_one_line() -> None:
    with pytest.raises(ModelError, match=r"slat encoder: 3 channels at 8\^3.*10 channels at 8\^3"):
        SlatEncoder(VAE)(voxels(0.2, 3))
    with pytest.raises(ModelError, match=r"4 channels at 4\^3"):
        SurfaceDecoder(VAE)(voxels(0.2, 4, resolution=4))
    with pytest.raises(ModelError, match="5 heads do not divide 24 channels"):
        replace(VAE, heads=5)
    with pytest.raises(ModelError, match="positive sizes"):
        replace(VAE, upsample=(0,))


def _shell(resolution: int) -> SparseGrid:
    ticks = (torch.arange(resolution) + 0.5) / resolution - 0.5
    radius = torch.stack(torch.meshgrid(ticks, ticks, ticks, indexing="ij")).norm(dim=0)
    return SparseGrid.from_occupancy(((radius - 0.4).abs() < 0.9 / resolution)[None])


def _kept_bytes_per_voxel(config: SlatVaeConfig) -> float:
    """Of all distinct storages that encoder and decoder keep for the backward pass; voxels on a sphere."""
    grid, kept = _shell(config.resolution), {}

    def keep(tensor: Tensor) -> Tensor:
        kept[tensor.untyped_storage().data_ptr()] = (
            tensor.untyped_storage()
        )  # held, so no address comes twice
        return tensor

    features = torch.randn(grid.voxels, config.feature_channels)
    encoder, decoder = SlatEncoder(config), SurfaceDecoder(config)
    parameters = {p.data_ptr() for p in (*encoder.parameters(), *decoder.parameters())}
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        decoder(encoder(SparseTensor(grid=grid, features=features)).mean)
    return sum(s.nbytes() for pointer, s in kept.items() if pointer not in parameters) / grid.voxels


def test_memory_is_linear_in_the_voxels() -> None:
    config = replace(VAE, window=8, upsample=(8,))
    small, large = (_kept_bytes_per_voxel(replace(config, resolution=r)) for r in (16, 48))
    assert _shell(48).voxels > 8 * _shell(16).voxels
    assert large < 1.2 * small
