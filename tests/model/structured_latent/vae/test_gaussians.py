"""What the gaussian decoder's channels mean, against the published formulas."""

import math

import pytest
import torch

from model.errors import ModelError
from model.networks.sparse.tensor import SparseTensor
from model.structured_latent.vae.decoder import GaussianDecoder
from model.structured_latent.vae.gaussians import (
    GAUSSIAN_CHANNELS,
    gaussians,
    offset_perturbation,
    split_gaussian_channels,
)
from tests.model.structured_latent.small_slat import VAE, trained, voxels


def _decoded(value: float = 0.0) -> SparseTensor:
    x = voxels(0.2, 1)
    return x.with_features(torch.full((x.grid.voxels, GAUSSIAN_CHANNELS), value))


def test_channels_are_in_the_published_order() -> None:
    channels = torch.arange(448.0)[None]
    named = split_gaussian_channels(channels)
    assert named.offset[0, :2].tolist() == [[0, 1, 2], [3, 4, 5]]
    firsts = [named.features_dc, named.scaling, named.rotation, named.opacity]
    assert [float(part[0, 0, 0]) for part in firsts] == [96, 192, 288, 416]
    assert float(named.opacity[0, -1, 0]) == 447


def test_zero_channels_give_the_biases() -> None:
    decoded, perturbation = _decoded(), offset_perturbation()
    for sample, found in enumerate(gaussians(decoded, perturbation)):
        at = decoded.grid.coordinates[decoded.grid.batch_index == sample]
        assert len(found.centers) == 32 * len(at)
        assert torch.allclose(found.scales, torch.tensor(math.hypot(4e-3, 9e-4)), rtol=1e-4)
        assert torch.allclose(found.opacities, torch.tensor(0.1))
        assert torch.allclose(found.colors, torch.tensor(0.5))
        assert found.rotations_wxyz[0].tolist() == [1, 0, 0, 0]
        # The first point of the sequence is the corner of the voxel's cube; all fill it once.
        offset_voxels = (found.centers.view(-1, 32, 3) + 0.5) * 8 - 0.5 - at[:, None]
        torch.testing.assert_close(offset_voxels[:, 0], torch.full((len(at), 3), -0.5), atol=1e-5, rtol=0)
        torch.testing.assert_close(offset_voxels.mean(1), torch.zeros(len(at), 3), atol=0.05, rtol=0)


def test_centers_stay_within_three_quarters_of_a_voxel() -> None:
    decoded = _decoded(1e4)
    for sample, found in enumerate(gaussians(decoded, offset_perturbation())):
        at = decoded.grid.coordinates[decoded.grid.batch_index == sample]
        offset_voxels = (found.centers.view(-1, 32, 3) + 0.5) * 8 - 0.5 - at[:, None]
        torch.testing.assert_close(offset_voxels, torch.full_like(offset_voxels, 0.75))


def test_decoded_gaussians_are_well_formed_and_differentiable() -> None:
    decoder, x = trained(GaussianDecoder(VAE)), voxels(0.2, VAE.latent_channels)
    assert isinstance(decoder, GaussianDecoder)
    found = gaussians(decoder(x), decoder.offset_perturbation)
    for cloud in found:
        assert torch.allclose(cloud.rotations_wxyz.norm(dim=1), torch.tensor(1.0))
        assert (cloud.scales > 9e-4).all()
        assert ((cloud.opacities > 0) & (cloud.opacities < 1)).all()
    sum(cloud.centers.sum() + cloud.scales.sum() + cloud.opacities.sum() for cloud in found).backward()
    assert decoder.input_layer.weight.grad is not None


def test_other_channels_are_one_line() -> None:
    with pytest.raises(ModelError, match="100 channels; expected 448"):
        split_gaussian_channels(torch.zeros(1, 100))
