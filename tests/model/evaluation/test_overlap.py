"""Overlap and distance on shapes whose answer is known."""

import pytest
import torch

from model.evaluation.overlap import intersection_over_union, mean_shape, voxel_chamfer


def cube(low: int, high: int, size: int = 16) -> torch.Tensor:
    shape = torch.zeros(size, size, size, dtype=torch.bool)
    shape[low:high, low:high, low:high] = True
    return shape


def test_iou_of_shifted_equal_disjoint_and_empty_shapes():
    a = torch.stack([cube(0, 4), cube(0, 4), cube(0, 4), torch.zeros(16, 16, 16, dtype=torch.bool)])
    b = torch.stack([cube(0, 4), cube(2, 6), cube(8, 12), torch.zeros(16, 16, 16, dtype=torch.bool)])
    expected = torch.tensor([1.0, 8 / (128 - 8), 0.0, 1.0])
    torch.testing.assert_close(intersection_over_union(a, b), expected)


def test_chamfer_of_single_voxels_is_their_distance_in_cube_sides():
    a, b = (torch.zeros(16, 16, 16, dtype=torch.bool) for _ in range(2))
    a[2, 3, 4] = b[2, 3, 12] = True
    assert voxel_chamfer(a, b) == pytest.approx(0.5)
    assert voxel_chamfer(a, a) == 0.0


def test_nothing_found_is_as_far_as_two_shapes_in_the_cube_can_be():
    """Finite, and never better than any guess."""
    a, nothing = torch.zeros(16, 16, 16, dtype=torch.bool), torch.zeros(16, 16, 16, dtype=torch.bool)
    a[0, 0, 0] = True
    farthest = a.flip((0, 1, 2))
    assert voxel_chamfer(a, nothing) == voxel_chamfer(nothing, a) == pytest.approx(3**0.5)
    assert voxel_chamfer(a, farthest) < voxel_chamfer(a, nothing)
    assert voxel_chamfer(nothing, nothing) == 0.0


def test_the_mean_shape_is_the_best_cut_through_the_mean() -> None:
    shapes = torch.zeros(3, 4, 4, 4, dtype=torch.bool)
    shapes[:, :2] = True  # common to all
    shapes[0, 2] = shapes[1, 3] = True  # each of one shape alone
    assert torch.equal(mean_shape(shapes), shapes[2])
    assert torch.equal(mean_shape(shapes[:1]), shapes[0])
    disjoint = torch.eye(3, dtype=torch.bool)[:, :, None, None].expand(3, 3, 2, 2)
    assert mean_shape(disjoint).any()  # an empty guess would have no overlap at all
