"""The 101 channels in TRELLIS' order, and what corners make of them."""

from typing import Any

import numpy as np
import pytest
import torch

from model.errors import ModelError
from model.surface.extraction import ExtractionConfig, extract_surface
from model.surface.fields import SurfaceFields, split_channels, surface_fields
from model.surface.lattice import corner_lattice
from tests.model.surface.shells import corner_points, grid

RESOLUTION = 16


def test_channels_have_their_places_and_the_distance_its_bias() -> None:
    channels = torch.arange(2 * 101, dtype=torch.float32).reshape(2, 101).requires_grad_()
    named = split_channels(channels, RESOLUTION)
    torch.testing.assert_close(named.distances[1], 101.0 + torch.arange(8) - 1 / RESOLUTION)
    assert named.deformations[0, 2, 1] == 8 + 3 * 2 + 1
    assert named.weights[0].tolist() == list(range(32, 53))
    assert named.color_logits[0, 3].tolist() == [53 + 18, 54 + 18, 55 + 18]
    assert named.normal_logits[0, 3].tolist() == [56 + 18, 57 + 18, 58 + 18]
    sum(part.sum() for part in vars(named).values()).backward()
    assert channels.grad is not None
    assert bool((channels.grad == 1.0).all())


def test_the_wrong_number_of_channels_is_refused() -> None:
    with pytest.raises(ModelError, match="53 channels; expected 101"):
        split_channels(torch.zeros(2, 53), RESOLUTION)


def test_corners_of_one_voxel_lie_where_their_number_says() -> None:
    """A single negative corner: the surface is a small cap around that corner."""
    voxel = torch.tensor([[3, 5, 7]])
    for corner in range(8):
        channels = torch.zeros(1, 101)
        channels[:, :8] = 1.0
        channels[0, corner] = -1.0
        mesh = extract_surface(surface_fields(voxel, channels, RESOLUTION), ExtractionConfig(seal=0)).mesh
        expected = corner_points(voxel.numpy(), RESOLUTION)[0, corner]
        middle = 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))
        assert np.abs(middle - expected).max() < 0.06 / RESOLUTION


def test_shared_corners_are_averaged_before_tanh_and_sigmoid() -> None:
    generator = torch.Generator().manual_seed(0)
    voxels = torch.tensor([[0, 0, 0], [1, 0, 0], [1, 1, 0]])
    channels = 3.0 * torch.randn(3, 101, generator=generator)
    lattice = corner_lattice(surface_fields(voxels, channels, RESOLUTION), margin=2)
    # The lattice point (1, 1, 1): corner 7 of the first voxel, 6 of the second, 4 of the third.
    row = lattice.row[tuple(np.array([1, 1, 1]) - lattice.origin)]
    mean = torch.stack([channels[0], channels[1], channels[2]])
    of = [7, 6, 4]
    distance = torch.stack([mean[v, c] for v, c in enumerate(of)]).mean() - 1 / RESOLUTION
    deform = torch.stack([mean[v, 8 + 3 * c : 11 + 3 * c] for v, c in enumerate(of)]).mean(0)
    color = torch.stack([mean[v, 53 + 6 * c : 56 + 6 * c] for v, c in enumerate(of)]).mean(0)
    assert lattice.distances[row] == pytest.approx(float(distance), abs=1e-6)
    expected = 1 / RESOLUTION - 0.5 + (1 - 1e-8) / (2 * RESOLUTION) * torch.tanh(deform)
    np.testing.assert_allclose(lattice.positions[row], expected.numpy(), atol=1e-3 / RESOLUTION)
    np.testing.assert_allclose(lattice.colors[row], torch.sigmoid(color).numpy(), atol=1e-6)
    assert (lattice.row >= 0).sum() == len(lattice.distances) == 16
    assert (lattice.row[[0, 1, -1, -2]] < 0).all()


def test_dense_grids_cover_every_corner_once() -> None:
    voxels = torch.from_numpy(grid(RESOLUTION))
    lattice = corner_lattice(surface_fields(voxels, torch.zeros(len(voxels), 101), RESOLUTION), margin=1)
    assert lattice.row.shape == (RESOLUTION + 3,) * 3
    assert len(lattice.positions) == (RESOLUTION + 1) ** 3
    assert lattice.positions.min() == -0.5
    assert lattice.positions.max() == 0.5


def _fields(**changes) -> SurfaceFields:
    values: dict[str, Any] = {
        "resolution": 4,
        "voxels": np.array([[0, 0, 0], [3, 3, 3]]),
        "distances": np.zeros((2, 8), np.float32),
        "deformations": np.zeros((2, 8, 3), np.float32),
        "color_logits": np.zeros((2, 8, 3), np.float32),
    }
    return SurfaceFields(**(values | changes))


def test_what_no_surface_can_be_made_of_is_one_clear_line() -> None:
    nan = np.zeros((2, 8, 3), np.float32)
    nan[1, 2, 0] = np.nan
    for changes, message in (
        ({"voxels": np.array([[0, 0, 0], [4, 0, 0]])}, "voxels reach from 0 to 4; expected 0..3"),
        ({"voxels": np.array([[1, 2, 3], [1, 2, 3]])}, "1 voxels come twice"),
        ({"deformations": nan}, "1 values of deformations are not finite"),
    ):
        with pytest.raises(ModelError, match=message):
            _fields(**changes)
    with pytest.raises(ModelError, match="no active voxel"):
        surface_fields(torch.zeros(0, 3, dtype=torch.int64), torch.zeros(0, 101), 4)
