"""Voxel features: as exact as stated, mirrored with the object, and projected where a camera sees the voxel."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Float
from torch import Tensor

from model.data.crop import mirrored_surface
from model.errors import ModelError
from model.structured_latent.object_features.object_views import ObjectView
from model.structured_latent.object_features.surface_features import (
    FEATURE_CHANNELS,
    corner_distances,
    object_features,
    projected_features,
)
from model.surface.fields import CORNERS
from tests.model.structured_latent.watertight_shapes import ball, ball_distance, plate, plate_distance, shell

RESOLUTION = 64
HALF = (0.4, 0.3, 0.015)  # a plate two voxels thick


def lattice(voxels: np.ndarray) -> np.ndarray:
    return (voxels[:, None] + CORNERS) / RESOLUTION - 0.5


@pytest.mark.parametrize(
    ("surface", "distance", "mean_voxels", "wrong_sides"),
    [
        (ball(), ball_distance(0.3), 0.02, 0.005),
        (plate(HALF), plate_distance(np.array(HALF)), 0.03, 0.01),
    ],
)
def test_corner_distances_are_those_of_the_watertight(surface, distance, mean_voxels, wrong_sides):
    voxels = np.argwhere(shell(distance))
    features = object_features(surface, voxels, RESOLUTION)
    true = distance(lattice(voxels)) * RESOLUTION
    assert np.abs(features.distances - true).mean() < mean_voxels
    wrong = ((features.distances < 0) != (true < 0)) & (np.abs(true) > 0.1)
    assert wrong.mean() < wrong_sides
    assert features.rows().shape == (len(voxels), FEATURE_CHANNELS)
    assert np.isfinite(features.rows()).all()


def test_normals_and_colors_are_means_of_the_points_inside():
    surface, voxels = ball(count=40_000), np.argwhere(shell(ball_distance(0.3)))
    features = object_features(surface, voxels, RESOLUTION)
    cell = np.floor((surface.points + 0.5) * RESOLUTION).astype(int)
    for row in np.flatnonzero(features.counts > 3)[::97]:
        inside = (cell == voxels[row]).all(axis=1)
        assert inside.sum() == features.counts[row]
        np.testing.assert_allclose(features.normals[row], surface.normals[inside].mean(0), atol=1e-5)
        np.testing.assert_allclose(features.colors[row], surface.colors[inside].mean(0) / 255, atol=1e-5)


def test_voxels_without_points_take_the_nearest_point():
    surface, voxels = ball(count=400), np.argwhere(shell(ball_distance(0.3)))
    features = object_features(surface, voxels, RESOLUTION)
    empty = np.flatnonzero(features.counts == 0)
    assert len(empty) > 0
    center = (voxels[empty[0]] + 0.5) / RESOLUTION - 0.5
    nearest = np.linalg.norm(surface.points - center, axis=1).argmin()
    np.testing.assert_array_equal(features.normals[empty[0]], surface.normals[nearest])
    np.testing.assert_allclose(features.colors[empty[0]], surface.colors[nearest] / 255, atol=1e-6)


def test_an_object_without_points_is_refused():
    surface = ball()
    bare = replace(surface, points=surface.points[:0], normals=surface.normals[:0], colors=surface.colors[:0])
    with pytest.raises(ModelError, match="no surface point"):
        object_features(bare, np.zeros((1, 3), int), RESOLUTION)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000))
def test_the_mirrored_object_has_the_mirrored_distances(seed):
    surface = plate((0.4, 0.2, 0.1), count=2000, seed=seed)
    points = np.random.default_rng(seed).uniform(-0.45, 0.45, (200, 3))
    flipped = points * [-1.0, 1.0, 1.0]
    there = corner_distances(mirrored_surface(surface), flipped)
    np.testing.assert_allclose(there, corner_distances(surface, points), atol=1e-6)
    again = mirrored_surface(mirrored_surface(surface))
    np.testing.assert_array_equal(again.points, surface.points)
    np.testing.assert_array_equal(again.sdf_points, surface.sdf_points)


class ImageItself:
    """An encoder whose tokens are the pixels."""

    channels = 3

    def __init__(self, grid: int) -> None:
        self.grid = grid

    def to(self, device, dtype) -> "ImageItself":
        return self

    def __call__(
        self, images: Float[Tensor, "batch view 3 size size"]
    ) -> Float[Tensor, "batch view token channel"]:
        return images.flatten(3).transpose(2, 3)


def view(image: np.ndarray, T_cam_from_canonical: np.ndarray) -> ObjectView:
    """By a camera of 48 pixels."""
    K = np.array([[60.0, 0, 24], [0, 60, 24], [0, 0, 1]])
    return ObjectView(image=image, K=K, T_cam_from_canonical=T_cam_from_canonical)


def test_projected_features_are_what_is_at_the_projections():
    """Images that show their own pixel coordinates: the features are the mean projection of the voxel."""
    size, rng = 48, np.random.default_rng(0)
    voxels = rng.integers(0, 64, (50, 3))
    column, row = np.meshgrid(np.arange(size), np.arange(size))
    image = np.stack([5 * column, 5 * row, np.full_like(row, 255)], axis=-1).astype(np.uint8)
    T = np.tile(np.eye(4), (2, 1, 1))
    T[0, :3, 3] = [0.0, 0, 2.5]
    T[1, :3, :3] = 0.5 * np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    T[1, :3, 3] = [0.1, 0, 2]
    views = [view(image, t) for t in T]
    found = projected_features(iter(views), torch.from_numpy(voxels), 64, ImageItself(size))
    centers = (voxels + 0.5) / 64 - 0.5
    expected = np.zeros((50, 2))
    for shown in views:
        cam = centers @ shown.T_cam_from_canonical[:3, :3].T + shown.T_cam_from_canonical[:3, 3]
        uvw = cam @ shown.K.T
        expected += 5 * (uvw[:, :2] / uvw[:, 2:] - 0.5) / 255 / 2  # pixel i is centred at i + 1/2
    np.testing.assert_allclose(found.features[:, :2], expected, atol=1e-5)
    assert (found.views == 2).all()


def test_a_voxel_behind_the_camera_or_beside_the_image_is_seen_by_no_view():
    T = np.eye(4)
    T[2, 3] = 0.1  # the camera is inside the cube
    voxels = torch.tensor([[32, 32, 0], [32, 32, 63], [63, 32, 32]])
    white = np.full((48, 48, 3), 255, np.uint8)
    found = projected_features([view(white, T)], voxels, 64, ImageItself(48))
    assert found.views.tolist() == [0, 1, 0]
    assert (found.features[0] == 0).all()
    assert (found.features[1] == 1).all()


def test_more_views_than_are_encoded_at_once_are_all_counted():
    T = np.eye(4)
    T[2, 3] = 2.0
    views = [view(np.full((48, 48, 3), value, np.uint8), T) for value in range(0, 190, 10)]
    found = projected_features(views, torch.tensor([[32, 32, 32]]), 64, ImageItself(48))
    assert found.views.tolist() == [19]
    torch.testing.assert_close(found.features, torch.full((1, 3), 90 / 255))
