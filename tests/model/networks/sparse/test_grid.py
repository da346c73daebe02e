"""Sparse grids: order, what is refused, and every derived map against its definition by brute force."""

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from model.errors import ModelError
from model.networks.embeddings import sincos_position_embedding
from model.networks.sparse.embeddings import voxel_position_embedding
from model.networks.sparse.grid import SparseGrid
from model.networks.sparse.sequences import Window
from model.networks.sparse.tensor import SparseTensor
from tests.model.networks.sparse.dense import from_dense, from_samples, occupancy_of, to_dense


def _occupancy(seed: int, batch: int, resolution: int, fraction: float) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(batch, resolution, resolution, resolution, generator=generator) < fraction


occupancies = st.builds(
    _occupancy,
    seed=st.integers(0, 2**31),
    batch=st.integers(1, 3),
    resolution=st.integers(1, 6),
    fraction=st.sampled_from([0.0, 0.02, 0.3, 1.0]),
)


def _rows(grid: SparseGrid) -> list[tuple[int, ...]]:
    return [(int(b), *map(int, p)) for b, p in zip(grid.batch_index, grid.coordinates, strict=True)]


@settings(max_examples=40, deadline=None)
@given(occupancies)
def test_dense_and_back(occupancy: torch.Tensor) -> None:
    dense = torch.randn(len(occupancy), 2, *occupancy.shape[1:]) * occupancy[:, None]
    x = from_dense(dense, occupancy)
    assert torch.equal(to_dense(x), dense)
    assert torch.equal(occupancy_of(x.grid), occupancy)
    assert x.grid.sample_sizes == tuple(occupancy.sum((1, 2, 3)).tolist())
    assert _rows(x.grid) == sorted(_rows(x.grid))


@settings(max_examples=20, deadline=None)
@given(occupancies, st.randoms(use_true_random=False))
def test_any_order_of_input_gives_the_same_grid(occupancy: torch.Tensor, random: object) -> None:
    x = from_dense(torch.randn(len(occupancy), 3, *occupancy.shape[1:]), occupancy)
    order = list(range(x.grid.voxels))
    random.shuffle(order)  # type: ignore[attr-defined]
    index = torch.tensor(order, dtype=torch.long)
    grid, row_of_input = SparseGrid.from_coordinates(
        coordinates=x.grid.coordinates[index].int(),
        batch_index=x.grid.batch_index[index].int(),
        batch_size=x.grid.batch_size,
        resolution=x.grid.resolution,
    )
    assert grid.same_voxels(x.grid)
    assert torch.equal(x.features[index][row_of_input], x.features)


def test_samples_are_collated() -> None:
    a, b, none = torch.tensor([[3, 0, 0], [0, 1, 2]]), torch.tensor([[1, 1, 1]]), torch.zeros(0, 3).long()
    x = from_samples(
        [torch.tensor([[3.0], [0.0]]), torch.zeros(0, 1), torch.tensor([[7.0]])], [a, none, b], 4
    )
    assert _rows(x.grid) == [(0, 0, 1, 2), (0, 3, 0, 0), (2, 1, 1, 1)]
    assert x.features[:, 0].tolist() == [0.0, 3.0, 7.0]
    assert x.grid.sample_sizes == (2, 0, 1)


@pytest.mark.parametrize(
    ("coordinates", "batch_index", "message"),
    [
        ([[0, 0, 0], [0, 0, 0]], [0, 0], "a voxel occurs twice"),
        ([[0, 0, 4]], [0], "coordinates from 0 to 4; expected 0 to 3"),
        ([[0, -1, 0]], [0], "coordinates from -1 to 0"),
        ([[0, 0, 0]], [2], "batch index from 2 to 2; expected 0 to 1"),
        ([[0, 0, 0]], [-1], "batch index from -1"),
    ],
)
def test_bad_voxels_are_refused(coordinates: list, batch_index: list, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        SparseGrid.from_coordinates(
            coordinates=torch.tensor(coordinates),
            batch_index=torch.tensor(batch_index),
            batch_size=2,
            resolution=4,
        )


def test_other_bad_input_is_refused() -> None:
    grid = SparseGrid.from_occupancy(torch.ones(1, 3, 3, 3, dtype=torch.bool))
    with pytest.raises(ModelError, match="not ascending"):
        SparseGrid(
            coordinates=grid.coordinates.flip(0),
            batch_index=grid.batch_index,
            batch_size=1,
            resolution=3,
        )
    with pytest.raises(ModelError, match="a cube"):
        SparseGrid.from_occupancy(torch.ones(1, 3, 3, 2, dtype=torch.bool))
    with pytest.raises(ModelError, match="5 feature rows; expected 27"):
        SparseTensor(grid=grid, features=torch.zeros(5, 2))
    with pytest.raises(ModelError, match="divides"):
        grid.coarsened(2)
    with pytest.raises(ModelError, match="odd size"):
        grid.neighbours(2)
    with pytest.raises(ModelError, match="shift < size"):
        Window(size=4, shift=4)


@settings(max_examples=30, deadline=None)
@given(occupancies, st.sampled_from([1, 3, 5]))
def test_neighbours_are_the_voxels_at_each_offset(occupancy: torch.Tensor, kernel: int) -> None:
    grid = SparseGrid.from_occupancy(occupancy)
    rows = _rows(grid)
    reach = range(-(kernel // 2), kernel // 2 + 1)
    offsets = list(itertools.product(reach, repeat=3))
    found = {
        (cell, row, neighbour)
        for cell, one, other in grid.neighbours(kernel).around_middle()
        for row, neighbour in zip(one.tolist(), other.tolist(), strict=True)
    }
    row_of = {voxel: row for row, voxel in enumerate(rows)}
    expected = {
        (cell, row, row_of[moved])
        for cell, offset in enumerate(offsets)
        for row, (sample, *p) in enumerate(rows)
        if offset != (0, 0, 0)
        and (moved := (sample, *(a + b for a, b in zip(p, offset, strict=True)))) in row_of
    }
    assert found == expected


@settings(max_examples=40, deadline=None)
@given(occupancies, st.integers(1, 4), st.data())
def test_windows_part_the_rows(occupancy: torch.Tensor, size: int, data: st.DataObject) -> None:
    shift = data.draw(st.integers(0, size - 1))
    grid = SparseGrid.from_occupancy(occupancy)
    sequences = grid.windows(Window(size=size, shift=shift))
    assert sequences.rows is not None
    groups = [set(part.tolist()) for part in sequences.rows.split(sequences.lengths)]
    expected: dict[tuple[int, ...], set[int]] = {}
    for row, (sample, *p) in enumerate(_rows(grid)):
        expected.setdefault((sample, *((a + shift) // size for a in p)), set()).add(row)
    assert sorted(map(sorted, groups)) == sorted(map(sorted, expected.values()))

    padded = sequences.padded
    assert torch.equal(padded.row_of_place[padded.place_of_row], torch.arange(grid.voxels))
    assert torch.equal(sequences.rows[sequences.places], torch.arange(grid.voxels))
    assert len(padded.row_of_place) == sum(bucket.count * bucket.length for bucket in padded.buckets)
    assert len(padded.row_of_place) <= 1.25 * grid.voxels


@settings(max_examples=30, deadline=None)
@given(occupancies)
def test_coarser_and_finer_grids(occupancy: torch.Tensor) -> None:
    grid = SparseGrid.from_occupancy(occupancy)
    subdivision = grid.subdivided()
    fine = occupancy
    for axis in (1, 2, 3):
        fine = fine.repeat_interleave(2, dim=axis)
    assert torch.equal(occupancy_of(subdivision.fine), fine)
    assert torch.equal(subdivision.fine.coordinates // 2, grid.coordinates[subdivision.parent])

    back = subdivision.fine.coarsened(2)
    assert back.coarse.same_voxels(grid)
    assert torch.equal(back.parent, subdivision.parent)
    assert back.children.tolist() == [8] * grid.voxels


def test_what_is_derived_is_made_once() -> None:
    grid = SparseGrid.from_occupancy(_occupancy(0, 2, 4, 0.5))
    window = Window(size=2, shift=1)
    x = SparseTensor(grid=grid, features=torch.zeros(grid.voxels, 1))
    y = x.with_features(torch.ones(grid.voxels, 2)).map(torch.neg)
    assert y.grid.neighbours(3) is grid.neighbours(3)
    assert y.grid.windows(window) is grid.windows(Window(size=2, shift=1))
    assert y.grid.coarsened(2).coarse.neighbours(3) is grid.coarsened(2).coarse.neighbours(3)
    assert y.grid.subdivided() is grid.subdivided()
    assert grid.neighbours(3) is not grid.neighbours(5)


def test_position_embedding_is_that_of_the_dense_grid() -> None:
    grid = SparseGrid.from_occupancy(_occupancy(0, 2, 8, 0.3))
    index = (grid.coordinates[:, 0] * 8 + grid.coordinates[:, 1]) * 8 + grid.coordinates[:, 2]
    for channels in (1024, 20):
        dense = sincos_position_embedding(8, 3, channels)
        assert torch.equal(voxel_position_embedding(grid, channels), dense[index])
