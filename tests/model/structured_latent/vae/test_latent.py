"""Distribution and normalisation of latents."""

import pytest
import torch

from model.errors import ModelError
from model.networks.sparse.tensor import SparseTensor
from model.structured_latent.vae.latent import LatentNormalisation, SlatDistribution, sample
from tests.model.structured_latent.small_slat import voxels


def _latents() -> list[SparseTensor]:
    scale, shift = torch.tensor([1.0, 3.0, 0.5, 9.0]).double(), torch.tensor([0.0, -2.0, 4.0, 100.0]).double()
    return [
        x.with_features(x.features * scale + shift + i)
        for i, x in enumerate([voxels(0.4, 4), voxels(0.1, 4), voxels(0.2, 4, resolution=4)])
    ]


def test_samples_have_mean_and_std() -> None:
    mean = voxels(1.0, 4)
    logvar = mean.with_features(torch.full_like(mean.features, 2.0).log() * 2)
    noise = torch.randn(mean.features.shape, generator=torch.Generator().manual_seed(0)).double()
    drawn = sample(SlatDistribution(mean=mean, logvar=logvar), noise)
    torch.testing.assert_close(drawn.features, mean.features + 2 * noise)
    assert drawn.grid is mean.grid


def test_measured_normalisation_whitens_each_channel_over_all_voxels() -> None:
    latents = _latents()
    normalisation = LatentNormalisation.measured(latents)
    rows = torch.cat([normalisation.normalised(latent).features for latent in latents])
    torch.testing.assert_close(rows.mean(0), torch.zeros(4), atol=1e-5, rtol=0)
    torch.testing.assert_close(rows.std(0, correction=0), torch.ones(4), atol=1e-5, rtol=0)


def test_restored_is_the_way_back() -> None:
    normalisation = LatentNormalisation.measured(_latents())
    for latent in _latents():
        back = normalisation.restored(normalisation.normalised(latent))
        torch.testing.assert_close(back.features, latent.features.float(), atol=1e-4, rtol=1e-5)


def test_a_checkpoint_carries_it() -> None:
    measured, loaded = LatentNormalisation.measured(_latents()), LatentNormalisation.identity(4)
    loaded.load_state_dict(measured.state_dict())
    assert torch.equal(loaded.mean, measured.mean)
    assert torch.equal(loaded.std, measured.std)
    assert not list(loaded.parameters())


def test_degenerate_latents_are_one_line() -> None:
    x = voxels(0.4, 4)
    with pytest.raises(ModelError, match="positive standard deviations"):
        LatentNormalisation.measured([x.with_features(torch.ones_like(x.features))])
    with pytest.raises(ModelError, match="no voxel to measure"):
        LatentNormalisation.measured([])
