"""The loss is zero for the true field, grows with errors, and each sample stands for itself."""

from dataclasses import fields

import numpy as np
import pytest
import torch

from model.data.batch import join_surfaces
from model.networks.sparse.tensor import SparseTensor
from model.structured_latent.object_features.surface_features import object_features
from model.structured_latent.vae.latent import SlatDistribution
from model.structured_latent.vae.surface_loss import SurfaceLoss, SurfaceLossConfig, surface_loss
from model.surface.fields import CHANNELS, CORNERS
from tests.model.networks.sparse.dense import from_samples
from tests.model.structured_latent.watertight_shapes import ball, ball_distance, shell

RESOLUTION = 64
CONFIG = SurfaceLossConfig(
    distance=1.0, surface=1.0, normal=0.1, corner=0.5, color=1.0, deformation=0.1, kl=1e-3, truncation=1.0
)


def coarse(radius: float) -> SparseTensor:
    voxels = torch.from_numpy(np.argwhere(shell(ball_distance(radius))))
    return from_samples([torch.zeros(len(voxels), 4)], [voxels], RESOLUTION)


def true_channels(x: SparseTensor, radius: float, levels: int) -> SparseTensor:
    """What a perfect decoder says of a ball whose colour is its place."""
    grid = x.grid
    for _ in range(levels):
        grid = grid.subdivided().fine
    corners = (grid.coordinates[:, None].numpy() + CORNERS) / grid.resolution - 0.5
    distance = ball_distance(radius)(corners) * grid.resolution
    channels = torch.zeros(grid.voxels, CHANNELS)
    channels[:, :8] = torch.from_numpy(distance).float() + 1 / grid.resolution
    place = torch.from_numpy((corners + 0.5).clip(0.01, 0.99)).float()
    channels[:, 53:].unflatten(1, (8, 6))[..., :3] = torch.logit(place)
    return SparseTensor(grid=grid, features=channels)


def measured(decoded: SparseTensor, x: SparseTensor, radius: float) -> SurfaceLoss:
    surface = ball(radius=radius)
    estimates = object_features(surface, x.grid.coordinates.numpy(), RESOLUTION).distances
    latent = SlatDistribution(mean=x, logvar=x)
    return surface_loss(
        decoded, latent, join_surfaces([surface], ["ball"]), torch.from_numpy(estimates), CONFIG
    )


@pytest.mark.parametrize("levels", [0, 1])
def test_the_true_field_costs_next_to_nothing(levels):
    x = coarse(0.3)
    loss = measured(true_channels(x, 0.3, levels), x, 0.3)
    cells = 2**levels
    assert float(loss.distance) < 0.02 * cells  # curvature within a cell
    assert float(loss.surface) < 0.02 * cells
    assert float(loss.normal) < 0.005
    assert float(loss.corner) < 0.03 * cells
    assert float(loss.color) < 0.01
    assert float(loss.deformation) == 0.0
    assert float(loss.kl) == 0.0


def test_a_shifted_field_costs_its_shift():
    """Half a cell too large: distance and surface show half a cell, the normals stay."""
    x = coarse(0.3)
    decoded = true_channels(x, 0.3, 0)
    decoded.features[:, :8] -= 0.5
    loss = measured(decoded, x, 0.3)
    assert float(loss.surface) == pytest.approx(0.5, abs=0.02)
    assert float(loss.distance) == pytest.approx(0.4, abs=0.1)
    assert float(loss.normal) < 0.005


def test_an_inside_out_field_is_pulled_back_everywhere():
    """Beyond the truncation too: no corner is left without a gradient towards its side."""
    x = coarse(0.3)
    decoded = true_channels(x, 0.3, 0)
    features = (-5 * decoded.features).requires_grad_()
    loss = measured(decoded.with_features(features), x, 0.3)
    loss.corner.sum().backward()
    with torch.no_grad():
        away = decoded.features[:, :8].abs() > 0.2
        towards = -features.grad[:, :8].sign() == decoded.features[:, :8].sign()
    assert (towards | ~away).float().mean() > 0.99


def test_each_sample_stands_for_itself():
    parts = [(coarse(radius), radius) for radius in (0.3, 0.2)]
    generator = torch.Generator().manual_seed(0)
    rows = [torch.randn(x.grid.voxels, CHANNELS, generator=generator) for x, _ in parts]
    latents = [torch.randn(x.grid.voxels, 4, generator=generator) for x, _ in parts]
    surfaces = [ball(radius=radius, count=4000 + 100 * i) for i, (_, radius) in enumerate(parts)]
    coordinates = [x.grid.coordinates for x, _ in parts]
    estimates = [
        torch.from_numpy(object_features(s, c.numpy(), RESOLUTION).distances)
        for s, c in zip(surfaces, coordinates)
    ]

    def loss(chosen: list[int]) -> SurfaceLoss:
        def pick(values):
            return [values[i] for i in chosen]

        latent = from_samples(pick(latents), pick(coordinates), RESOLUTION)
        decoded = from_samples(pick(rows), pick(coordinates), RESOLUTION)
        truth = join_surfaces(pick(surfaces), ["a", "b"][: len(chosen)])
        distribution = SlatDistribution(mean=latent, logvar=latent)
        return surface_loss(decoded, distribution, truth, torch.cat(pick(estimates)), CONFIG)

    both, first, second = loss([0, 1]), loss([0]), loss([1])
    for field in fields(SurfaceLoss):
        a, b, c = (getattr(each, field.name) for each in (both, first, second))
        torch.testing.assert_close(a, torch.cat([b, c]), rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(
        both.weighted(CONFIG),
        torch.cat([first.weighted(CONFIG), second.weighted(CONFIG)]),
        rtol=1e-4,
        atol=1e-6,
    )


def test_autocast_changes_nothing():
    x = coarse(0.3)
    decoded = true_channels(x, 0.3, 1)
    plain = measured(decoded, x, 0.3)
    with torch.autocast("cpu", torch.bfloat16):
        cast = measured(decoded, x, 0.3)
    for field in fields(SurfaceLoss):
        torch.testing.assert_close(getattr(cast, field.name), getattr(plain, field.name), rtol=0, atol=0)


def test_a_sample_that_is_not_a_number_can_be_named():
    x = coarse(0.3)
    decoded = true_channels(x, 0.3, 0)
    decoded.features[7, 0] = float("nan")
    assert not torch.isfinite(measured(decoded, x, 0.3).weighted(CONFIG)).all()
