"""A sampled scene: repeatable, independent streams, nothing floats or sinks, true labels."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from datagen.grasps.sequence import TableEdge
from datagen.hands.model import pose_hand, shape_hand
from datagen.sampling.clip import clip_windows, object_movement
from datagen.sampling.errors import SamplingError
from datagen.sampling.frustum import FrustumError, frustum_report, require_frustum
from datagen.sampling.scene_sampling import sample_scene
from datagen.sampling.streams import Stream, stream_rng
from datagen.scene.scene_file import scene_sha256
from datagen.scene.table_mesh import inside_flat_top, table_from_world
from shards.geometry import camera_center, transform_points


@pytest.fixture(scope="module")
def sample(make_sequence, hand, skins, asset, config):
    def draw(index: int, *, seed: int = 5, settings=config, sequence=None, **kind):
        return sample_scene(
            sequence or make_sequence(**kind),
            hand,
            skins,
            asset,
            settings,
            dataset_seed=seed,
            motion_index=index,
            motion_id=f"motion-{index:06d}",
        )

    return draw


def with_clip(config, **changes):
    return replace(config, clip=replace(config.clip, **changes))


def test_the_same_motion_is_the_same_scene_whatever_came_before(sample):
    first = scene_sha256(sample(3).scene)
    sample(4)
    assert scene_sha256(sample(3).scene) == first
    assert scene_sha256(sample(4).scene) != first
    assert scene_sha256(sample(3, seed=6).scene) != first


def test_a_change_in_one_stream_leaves_the_others(sample, config):
    """Other lamps: cameras, table, looks and clip stay the same to the last bit."""
    before = sample(2)
    lit = sample(
        2, settings=replace(config, lights=replace(config.lights, n_lamps=(4, 4), size_m=(0.1, 0.2)))
    )
    assert len(lit.scene.lights) == 4
    assert lit.scene.background == before.scene.background
    for name in ("cameras", "table", "hand_look", "render", "seed"):
        assert repr(getattr(lit.scene, name)) == repr(getattr(before.scene, name)), name
    np.testing.assert_array_equal(lit.scene.T_world_from_obj, before.scene.T_world_from_obj)
    plain = sample(2, settings=replace(config, appearance=replace(config.appearance, bump=(0.9, 0.95))))
    assert repr(plain.scene.cameras) == repr(before.scene.cameras)
    assert plain.scene.lights[0].power_w == before.scene.lights[0].power_w


def test_streams_do_not_overlap():
    draws = {
        tuple(stream_rng(seed, motion, stream, *parts).integers(2**62, size=2))
        for seed in (0, 1)
        for motion in (0, 1, 2)
        for stream in Stream
        for parts in ((), (1,), (2,))
    }
    assert len(draws) == 2 * 3 * len(Stream) * 3


def test_labels_are_those_of_the_drawn_frames(sample, hand, config):
    sampled = sample(1)
    sequence, scene = sampled.sequence, sampled.scene
    frames = sampled.contact_force_n[:, 0].astype(int)  # `make_sequence` numbers them there
    assert len(frames) == config.clip.n_frames
    np.testing.assert_array_equal(np.diff(frames).round(-1) > 0, True)
    assert abs((frames[-1] - frames[0]) / sequence.fps - (len(frames) - 1) / scene.fps) <= 1.0 / sequence.fps
    posed = pose_hand(
        hand,
        orientation_world=sampled.hand_orientation_world,
        hand_pose=sampled.hand_pose,
        translation_world=sampled.hand_translation_world,
        flat_hand_mean=True,
    )
    n_hand = scene.hand_surface.n_hand_verts
    np.testing.assert_array_equal(posed.verts_world, scene.hand_verts_world[:, :n_hand])
    np.testing.assert_array_equal(posed.joints_world, sampled.joints_world)
    np.testing.assert_array_equal(scene.T_world_from_obj, sequence.T_world_from_obj[frames])
    assert scene.hand_surface.faces.max() < scene.hand_verts_world.shape[1]


@pytest.mark.parametrize("index", range(4))
def test_an_object_that_is_not_yet_held_lies_on_its_table(sample, config, index):
    settings = with_clip(config, pickup_probability=1.0)
    sampled = sample(index, settings=settings)
    scene, table = sampled.scene, sampled.scene.table
    assert sampled.grasp_frame > 0
    assert table is not None
    obj = transform_points(scene.T_world_from_obj[0], scene.object_mesh.verts_obj)
    assert abs(obj[:, 2].min() - table.top_z_m) < 1e-9
    to_table = table_from_world(table)
    x, y = to_table[:, :2] @ obj[:, :2].T + to_table[:, 2:]
    assert inside_flat_top(table, x, y).all()
    assert scene.hand_verts_world[..., 2].min() > table.top_z_m - 0.0031
    for lamp in scene.lights:
        assert lamp.position_world[2] > table.top_z_m


def test_a_motion_that_begins_in_mid_air_is_drawn_once_it_is_held(sample, config):
    settings = with_clip(config, pickup_probability=1.0)
    for index in range(3):
        sampled = sample(index, settings=settings, start="held")
        assert sampled.grasp_frame == 0
        if sampled.scene.table is not None:
            obj = transform_points(
                sampled.scene.T_world_from_obj,
                np.broadcast_to(
                    sampled.scene.object_mesh.verts_obj, (12, *sampled.scene.object_mesh.verts_obj.shape)
                ),
            )
            lowest = min(obj[..., 2].min(), sampled.scene.hand_verts_world[..., 2].min())
            assert sampled.scene.table.top_z_m < lowest


def test_a_table_ends_at_the_edge_the_object_overhangs(sample, config):
    edge = TableEdge(point_xy_m=(0.015, 0.0), outward_xy=(0.6, 0.8))
    settings = with_clip(config, pickup_probability=1.0)
    for index in range(2):
        table = sample(index, settings=settings, start="edge", edge=edge).scene.table
        to_table = table_from_world(table)
        for beyond_m, inside in ((0.001, False), (-0.01, True)):
            point = np.array(edge.point_xy_m) + beyond_m * np.array(edge.outward_xy)
            x, y = to_table[:, :2] @ point + to_table[:, 2]
            assert inside_flat_top(table, np.array([x]), np.array([y]))[0] == inside


def test_drawn_vertices_prove_the_frustum(sample, config):
    for index in range(2):
        sampled = sample(index)
        side = min(config.cameras.image_size)
        require_frustum(sampled, config.cameras)
        for camera, metrics, report in zip(
            sampled.scene.cameras, sampled.camera_metrics, frustum_report(sampled.scene)
        ):
            assert camera.kind == metrics.kind
            assert report.min_margin_px >= config.cameras.margin * side - 1e-6
            assert report.object_drift_px <= config.cameras.max_drift * side + 1e-6
            assert metrics.visible_fraction_min >= config.cameras.min_visible
            assert metrics.attempts <= config.cameras.attempts
            if sampled.scene.table is not None:
                height = camera_center(camera.T_cam_from_world)[:, 2].min() - sampled.scene.table.top_z_m
                assert height >= config.cameras.table_clearance_m


def test_a_camera_that_does_not_keep_its_promise_is_an_error(sample, config):
    """Each of the four claims on its own: margin, drift, and the two recorded numbers."""
    sampled, side = sample(0), min(config.cameras.image_size)
    camera, metrics = sampled.scene.cameras[1], sampled.camera_metrics[1]
    aside = camera.T_cam_from_world.copy()
    aside[:, 0, 3] += 0.2  # metres to the left: out of view
    cameras = (sampled.scene.cameras[0], replace(camera, T_cam_from_world=aside))
    lost = replace(sampled, scene=replace(sampled.scene, cameras=cameras))
    with pytest.raises(FrustumError, match=r"motion-000000, camera 1: vertices keep -\d+\.\d+ px"):
        require_frustum(lost, config.cameras)
    drift = max(report.object_drift_px for report in frustum_report(sampled.scene)) / side
    with pytest.raises(FrustumError, match="the object drifts"):
        require_frustum(sampled, replace(config.cameras, max_drift=0.9 * drift))
    for name, problem in (("min_margin_px", "recorded margin"), ("object_drift_px", "recorded drift")):
        wrong = replace(metrics, **{name: getattr(metrics, name) + 0.1})
        recorded = replace(sampled, camera_metrics=(sampled.camera_metrics[0], wrong))
        with pytest.raises(FrustumError, match=f"camera 1: the {problem}"):
            require_frustum(recorded, config.cameras)


def test_more_moving_parts_come_first(make_sequence, config):
    sequence = make_sequence()
    still, moving = (
        [
            next(
                clip_windows(sequence, with_clip(config, pickup_probability=0.0, preference=p).clip, rng)
            ).movement_rad
            for rng in (np.random.default_rng(seed) for seed in range(40))
        ]
        for p in (0.0, 6.0)
    )
    assert np.mean(moving) > 1.3 * np.mean(still)


def test_other_rates_follow_when_no_window_of_the_drawn_one_works(make_sequence, config):
    """A motion that is held for a moment only can still be drawn, faster."""
    rates = [window.fps for window in clip_windows(make_sequence(), config.clip, np.random.default_rng(4))]
    changes = [rates[0], *(b for a, b in pairwise(rates) if a != b)]
    assert sorted(changes) == sorted(config.clip.fps)  # each rate in one go, the drawn one first
    assert changes[1:] == sorted(changes[1:], reverse=True)


def test_movement_adds_turn_and_travel():
    T = np.tile(np.eye(4), (3, 1, 1))
    T[1, :3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    T[2, :3, 3] = [0.0, 0.6, 0.0]
    assert abs(object_movement(T) - (np.pi / 2 + 2.0)) < 1e-9


def test_what_cannot_be_drawn_is_an_error_with_metrics(sample, make_sequence, hand, skins, asset, config):
    with pytest.raises(SamplingError, match=r"too few for clips of 12 frames at .*raise clip\.fps"):
        sample(0, n_frames=130)
    with pytest.raises(SamplingError, match="pass the hand it was made with"):
        sample_scene(
            make_sequence(),
            shape_hand(hand.model, np.full(10, 0.5)),
            skins,
            asset,
            config,
            dataset_seed=0,
            motion_index=0,
            motion_id="m",
        )
    sunk = make_sequence()
    sunk.hand_translation_world[:] -= [0.0, 0.0, 0.08]
    only_pickup = replace(sunk, grasp_frame=len(sunk.T_world_from_obj))
    with pytest.raises(SamplingError, match="sink into the table"):
        sample(0, settings=with_clip(config, before_grasp_s=4.0), sequence=only_pickup)
