"""Small networks of stage 2 and random voxels for them."""

from dataclasses import replace

import torch
from torch import nn

from model.networks.sparse.tensor import SparseTensor
from model.structured_latent.flow import SlatFlowConfig
from model.structured_latent.vae.latent import SlatVaeConfig
from tests.model.networks.sparse.dense import from_dense, from_samples

VAE = SlatVaeConfig(
    feature_channels=10,
    channels=24,
    latent_channels=4,
    blocks=3,
    heads=2,
    mlp_ratio=2,
    window=4,
    upsample=(16, 8),
    resolution=8,
)
FLOW = SlatFlowConfig(
    resolution=8,
    latent_channels=4,
    channels=24,
    condition_channels=12,
    blocks=2,
    heads=2,
    mlp_ratio=2,
    patch=2,
    io_channels=(8,),
    pool_pseudo_count=0,
    checkpoint_blocks=False,
    preconditioned=False,
)
PAPER_FLOW = SlatFlowConfig(
    resolution=64,
    latent_channels=8,
    channels=1024,
    condition_channels=1024,
    blocks=24,
    heads=16,
    mlp_ratio=4,
    patch=2,
    io_channels=(128,),
    pool_pseudo_count=1,
    checkpoint_blocks=True,
    preconditioned=False,
)
TWO_LEVELS = replace(FLOW, patch=4, io_channels=(8, 16))


def voxels(fraction: float, channels: int, *, batch: int = 2, resolution: int = 8) -> SparseTensor:
    """Random features on about `fraction` of the cells; float64."""
    generator = torch.Generator().manual_seed(3)
    occupancy = torch.rand(batch, *[resolution] * 3, generator=generator) < fraction
    dense = torch.randn(batch, channels, *[resolution] * 3, generator=generator, dtype=torch.float64)
    return from_dense(dense, occupancy)


def one_sample(x: SparseTensor, sample: int) -> SparseTensor:
    rows = x.grid.batch_index == sample
    return from_samples([x.features[rows]], [x.grid.coordinates[rows]], x.grid.resolution)


def trained(network: nn.Module) -> nn.Module:
    """In float64, every parameter moved off its initial value: zeros hide what they multiply."""
    generator = torch.Generator().manual_seed(1)
    network.double()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += 0.1 * torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
    return network


def without_gradient(network: nn.Module) -> list[str]:
    """Names of parameters that the last backward pass did not reach."""
    return [
        name
        for name, parameter in network.named_parameters()
        if parameter.grad is None or not parameter.grad.any()
    ]
