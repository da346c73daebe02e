"""The sparse-structure VAE: shapes, loss, and that it learns a shape."""

import math

import pytest
import torch

from model.errors import ModelError
from model.sparse_structure.vae import (
    LatentDistribution,
    StructureVae,
    VaeConfig,
    occupancy_from_logits,
    sample_latent,
    vae_loss,
)

SMALL = VaeConfig(patch=1, channels=(4, 8, 16), latent_channels=8, residual_blocks=(0, 1, 2), middle_blocks=1)


def _sphere(resolution: int, radius: float) -> torch.Tensor:
    ticks = (torch.arange(resolution) + 0.5) / resolution - 0.5
    x, y, z = torch.meshgrid(ticks, ticks, ticks, indexing="ij")
    return (x**2 + y**2 + z**2 < radius**2)[None]


@pytest.mark.parametrize(
    ("patch", "channels", "latent"),
    [(1, (4, 8, 16), 16), (1, (4, 4, 8, 8), 8), (2, (8, 16), 16), (4, (8, 8), 8)],
)
def test_64_cubed_to_its_latent_and_back(patch: int, channels: tuple[int, ...], latent: int) -> None:
    blocks = (0,) + (1,) * (len(channels) - 1)
    config = VaeConfig(
        patch=patch, channels=channels, latent_channels=8, residual_blocks=blocks, middle_blocks=1
    )
    vae = StructureVae(config)
    assert config.latent_shape(64) == (8, latent, latent, latent)
    with torch.no_grad():
        posterior = vae.encoder(_sphere(64, 0.4))
        assert posterior.mean.shape == posterior.logvar.shape == (1, 8, latent, latent, latent)
        logits = vae.decoder(posterior.mean)
    assert logits.shape == (1, 64, 64, 64)
    assert torch.equal(occupancy_from_logits(logits), logits > 0)


def test_loss_is_dice_plus_kl_by_hand() -> None:
    occupancy = torch.zeros(2, 2, 2, 2, dtype=torch.bool)
    occupancy[0, 0] = True  # 4 of 8 voxels; the second sample is empty
    logits = torch.zeros(2, 2, 2, 2)  # probability 1/2 everywhere
    posterior = LatentDistribution(
        mean=torch.full((2, 1, 1, 1, 1), 2.0), logvar=torch.full((2, 1, 1, 1, 1), 1.0)
    )
    loss = vae_loss(logits, posterior, occupancy)
    dice = [1 - (2 * 2 + 1) / (4 + 4 + 1), 1 - 1 / (4 + 0 + 1)]
    kl = 0.5 * (4 + math.e - 1 - 1)
    torch.testing.assert_close(loss.dice, torch.tensor(dice))
    torch.testing.assert_close(loss.kl, torch.full((2,), kl))
    assert float(loss.total) == pytest.approx(sum(dice) / 2 + 1e-3 * kl)


def test_latent_draws_follow_the_posterior() -> None:
    shape = (1, 4, 2, 2, 2)
    posterior = LatentDistribution(mean=torch.full(shape, 3.0), logvar=torch.full(shape, math.log(0.25)))
    noise = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(sample_latent(posterior, noise), 3.0 + 0.5 * noise)


def test_learns_a_sphere_and_a_cube() -> None:
    torch.manual_seed(0)
    cube = torch.zeros(1, 16, 16, 16, dtype=torch.bool)
    cube[:, 3:12, 4:13, 5:14] = True
    shapes = torch.cat([_sphere(16, 0.4), cube])
    vae = StructureVae(SMALL)
    optimizer = torch.optim.Adam(vae.parameters(), lr=5e-3)
    generator = torch.Generator().manual_seed(0)
    for _ in range(120):
        optimizer.zero_grad()
        vae(shapes, torch.randn(2, *SMALL.latent_shape(16), generator=generator)).total.backward()
        optimizer.step()
    with torch.no_grad():
        predicted = occupancy_from_logits(vae.decoder(vae.encoder(shapes).mean))
    both = (predicted & shapes).sum((1, 2, 3)) / (predicted | shapes).sum((1, 2, 3))
    assert float(both.min()) > 0.95


def test_bad_sizes_are_one_clear_line() -> None:
    with pytest.raises(ModelError, match="does not divide resolution 30"):
        SMALL.latent_shape(30)
    with pytest.raises(ModelError, match="multiples of 4"):
        StructureVae(SMALL).encoder(torch.zeros(1, 10, 10, 10, dtype=torch.bool))
    with pytest.raises(ModelError, match="positive sizes"):
        VaeConfig(patch=1, channels=(), latent_channels=8, residual_blocks=(), middle_blocks=1)
    with pytest.raises(ModelError, match="for 2 levels"):
        VaeConfig(patch=1, channels=(4, 8), latent_channels=8, residual_blocks=(1,), middle_blocks=1)
