"""The decoded field is the one that is extracted: exact for a plane under any deformation, differentiable."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from model.networks.sparse.grid import SparseGrid
from model.networks.sparse.tensor import SparseTensor
from model.structured_latent.prediction import decoded_fields
from model.structured_latent.vae.surface_lattice import DecodedLattice, decoded_lattice
from model.surface.extraction import ExtractionConfig, extract_surface
from model.surface.fields import CHANNELS
from model.surface.lattice import corner_lattice
from tests.model.networks.sparse.dense import from_samples

RESOLUTION = 8


def slab_grid(batch: int = 1) -> SparseGrid:
    occupancy = torch.zeros(batch, *[RESOLUTION] * 3, dtype=torch.bool)
    occupancy[:, 1:7, 1:7, 2:6] = True
    return SparseGrid.from_occupancy(occupancy)


def random_channels(grid: SparseGrid, seed: int, deformation: float) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    channels = torch.randn(grid.voxels, CHANNELS, generator=generator)
    channels[:, 8:32] *= deformation
    return channels


def with_plane(lattice: DecodedLattice, normal: torch.Tensor, offset: float) -> DecodedLattice:
    """The same deformed corners with the distance to a plane, in cells, as their values."""
    grid = lattice.grid
    corner = torch.zeros(len(lattice.distances), 3)
    bits = torch.tensor([[c & 1, c >> 1 & 1, c >> 2 & 1] for c in range(8)])
    corner[lattice.corner_of_voxel.flatten()] = (grid.coordinates[:, None] + bits).flatten(0, 1).float()
    return DecodedLattice(
        grid=grid,
        corner_of_voxel=lattice.corner_of_voxel,
        distances=(corner + lattice.offsets) @ normal - offset,
        offsets=lattice.offsets,
        colors=lattice.colors,
    )


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_a_plane_stays_a_plane_under_any_deformation(seed):
    """Trilinear position and trilinear distance cancel: value and gradient are exact wherever a point lies."""
    grid, generator = slab_grid(), torch.Generator().manual_seed(seed)
    normal = torch.nn.functional.normalize(torch.randn(3, generator=generator), dim=0)
    decoded = SparseTensor(grid=grid, features=random_channels(grid, seed, 0.4))
    lattice = with_plane(decoded_lattice(decoded), normal, 4.0)
    points = (
        torch.rand(60, 3, generator=generator) * torch.tensor([4, 4, 2.0]) + torch.tensor([2, 2, 3.0])
    ) / 8 - 0.5
    field = lattice.at(points, torch.zeros(60, dtype=torch.long))
    assert field.inside.all()
    true = (points + 0.5) * RESOLUTION @ normal - 4.0
    # Four rounds bring the cell's coordinates to about a hundredth of a cell, and the last one is linear.
    torch.testing.assert_close(field.distance, true, atol=5e-3, rtol=0)
    torch.testing.assert_close(
        field.slope, torch.einsum("pxu,x->pu", field.jacobian, normal), atol=1e-4, rtol=0
    )


def test_corners_are_those_that_the_extraction_uses():
    grid = slab_grid()
    decoded = SparseTensor(grid=grid, features=random_channels(grid, 3, 1.0))
    ours = decoded_lattice(decoded)
    theirs = corner_lattice(decoded_fields(decoded, 0), margin=2)
    bits = np.array([[c & 1, c >> 1 & 1, c >> 2 & 1] for c in range(8)])
    corners = grid.coordinates.numpy()[:, None] + bits
    rows = theirs.row[tuple(np.moveaxis(corners - theirs.origin, -1, 0))]
    of_ours = ours.corner_of_voxel.numpy()
    np.testing.assert_allclose(ours.distances.numpy()[of_ours], theirs.distances[rows], atol=1e-5)
    np.testing.assert_allclose(ours.colors.numpy()[of_ours], theirs.colors[rows], atol=1e-5)
    position = (corners + ours.offsets.numpy()[of_ours]) / RESOLUTION - 0.5
    np.testing.assert_allclose(position, theirs.positions[rows], atol=1e-5)


def test_the_field_is_zero_on_the_extracted_surface():
    """Between corners of the lattice, vertices lie on cell edges, where trilinear is linear."""
    grid = slab_grid()
    normal = torch.tensor([0.0, 0.0, 1.0])
    plain = SparseTensor(grid=grid, features=torch.zeros(grid.voxels, CHANNELS))
    lattice = with_plane(decoded_lattice(plain), normal, 4.3)
    features = plain.features.clone()
    features[:, :8] = lattice.distances[lattice.corner_of_voxel] + 1 / RESOLUTION
    decoded = plain.with_features(features)
    mesh = extract_surface(decoded_fields(decoded, 0), ExtractionConfig(seal=0)).mesh
    field = decoded_lattice(decoded).at(
        torch.from_numpy(mesh.vertices), torch.zeros(len(mesh.vertices), dtype=torch.long)
    )
    level = np.abs((mesh.vertices[:, 2] + 0.5) * RESOLUTION - 4.3) < 1e-3
    assert level.any()
    assert field.distance[torch.from_numpy(level)[field.inside]].abs().max() < 1e-3


def test_samples_of_a_batch_do_not_meet():
    grid = slab_grid(2)
    features = random_channels(grid, 5, 0.3)
    both = decoded_lattice(SparseTensor(grid=grid, features=features))
    points = torch.full((1, 3), 0.05)
    for sample in (0, 1):
        rows = grid.batch_index == sample
        alone = decoded_lattice(from_samples([features[rows]], [grid.coordinates[rows]], RESOLUTION))
        a = both.at(points, torch.tensor([sample])).distance
        torch.testing.assert_close(a, alone.at(points, torch.tensor([0])).distance)


@pytest.mark.parametrize("point", [(-0.49, 0.0, 0.0), (0.7, 0.0, 0.0)])
def test_points_outside_the_active_voxels_are_left_out(point):
    grid = slab_grid()
    lattice = decoded_lattice(SparseTensor(grid=grid, features=random_channels(grid, 1, 0.1)))
    field = lattice.at(torch.tensor([point]), torch.tensor([0]))
    assert not field.inside.any()
    assert len(field.distance) == 0


def test_gradients_reach_distances_deformations_and_colors():
    grid = slab_grid()
    features = random_channels(grid, 2, 0.1).requires_grad_()
    field = decoded_lattice(SparseTensor(grid=grid, features=features)).at(
        torch.rand(200, 3) * 0.4 - 0.2, torch.zeros(200, dtype=torch.long)
    )
    (field.distance.square().sum() + field.color.sum()).backward()
    gradient = features.grad
    for channels in (slice(0, 8), slice(8, 32), [53, 54, 55]):
        assert gradient[:, channels].abs().sum() > 0
    assert gradient[:, 32:53].abs().sum() == 0  # FlexiCubes weights are not used
