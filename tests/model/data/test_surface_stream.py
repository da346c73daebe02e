"""Surface samples in the stream: only when asked for, each sample's own, mirrored with everything else."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from model.data.crop import mirrored
from model.data.order import SampleKey
from model.data.reader import SampleReader
from model.data.stream import ShardStream
from model.errors import ModelError
from shards.reader import open_dataset
from tests.model.data.balls import VARIED, stream_config, take, write_balls


@pytest.fixture(scope="module")
def balls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_balls(tmp_path_factory.mktemp("data") / "balls")


def test_surfaces_are_read_only_when_asked_for(balls):
    (plain,) = take(ShardStream(stream_config(balls)), 1)
    assert plain.surface is None
    with pytest.raises(ModelError, match="surface"):
        _ = plain.true_surface
    (asked,) = take(ShardStream(stream_config(balls, surface=True)), 1)
    assert torch.equal(plain.images, asked.images)
    assert asked.true_surface.point_counts == (400,) * 4
    assert asked.true_surface.sdf_counts == (300,) * 4


def test_samples_carry_what_the_shard_says_of_their_object(balls):
    config = stream_config(balls, surface=True, augmentation=replace(VARIED, flip_probability=0.0))
    (batch,) = take(ShardStream(config), 1)
    rows = {row.object_uid: row for row in open_dataset(str(balls)).objects()}
    for place in range(4):
        part = batch.part(place, place + 1)
        row = rows[part.true_surface.object_uids[0]]
        np.testing.assert_array_equal(part.true_surface.points, row.surface_points)
        np.testing.assert_array_equal(part.true_surface.normals, row.surface_normals)
        np.testing.assert_array_equal(part.true_surface.colors, row.surface_colors)
        np.testing.assert_array_equal(part.true_surface.sdf_points, row.sdf_points)
        np.testing.assert_array_equal(part.true_surface.sdf_values, row.sdf_values)
        assert part.true_surface.object_scales_m == (row.object_scale_m,)


def test_loader_processes_send_the_same_surfaces(balls):
    here, there = (
        take(ShardStream(stream_config(balls, surface=True, workers=workers)), 2) for workers in (0, 1)
    )
    for a, b in zip(here, there):
        for name in ("points", "normals", "colors", "sdf_points", "sdf_values"):
            assert torch.equal(getattr(a.true_surface, name), getattr(b.true_surface, name))
        assert a.true_surface.object_uids == b.true_surface.object_uids
        assert a.true_surface.are_mirrored == b.true_surface.are_mirrored
    seen = {flag for batch in there for flag in batch.true_surface.are_mirrored}
    assert seen == {False, True}


@pytest.mark.parametrize("position", range(4))
def test_a_mirrored_sample_keeps_every_distance(balls, position):
    """Distances between surface samples, occupied voxels and cameras are what they were."""
    config = stream_config(balls, surface=True, augmentation=replace(VARIED, flip_probability=0.0))
    reader = SampleReader(ShardStream(config).index, config)
    sample, _ = reader.read(SampleKey(epoch=0, position=position, item=0, n_views=2))
    other = mirrored(sample)
    again = mirrored(other)
    np.testing.assert_array_equal(again.surface.points, sample.surface.points)

    def distances(s):
        surface = s.surface
        voxels = (np.argwhere(s.occupancy) + 0.5) / 64 - 0.5
        camera = np.linalg.inv(s.T_cam_from_canonical.astype(np.float64))[:, :3, 3]
        tips = surface.points + 0.01 * surface.normals
        anchors = np.concatenate([surface.points[:20], surface.sdf_points[:20], tips[:20], camera])
        to_voxels = np.linalg.norm(anchors[:, None] - voxels[None], axis=2)
        return np.linalg.norm(anchors[:, None] - anchors[None], axis=2), np.sort(to_voxels, axis=1)

    for a, b in zip(distances(sample), distances(other)):
        np.testing.assert_allclose(a, b, atol=1e-5)
    np.testing.assert_array_equal(other.surface.sdf_values, sample.surface.sdf_values)
    np.testing.assert_array_equal(other.surface.points[:, 0], -sample.surface.points[:, 0])
    assert (sample.surface.is_mirrored, other.surface.is_mirrored, again.surface.is_mirrored) == (0, 1, 0)
