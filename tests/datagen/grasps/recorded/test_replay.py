"""A recorded motion comes back as it was with the hand it was made with, and says so when it is not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datagen.config import read_config
from datagen.grasps.contact import digit_distances, signed_distances
from datagen.grasps.object_surface import ObjectSurface
from datagen.grasps.recorded.graspxl import find_sequences, read_sequence
from datagen.grasps.recorded.replay import ReplayConfig, ReplayError, replay
from datagen.grasps.synthesis.synthesise import synthesise_grasp
from datagen.hands.model import pose_hand, shape_hand
from shards.geometry import invert_transform
from tests.datagen.grasps.recorded.official_files import recorded_arrays, write_sequence

UID = "0123456789abcdef0123456789abcdef"


@pytest.fixture(scope="module")
def settings() -> ReplayConfig:
    return replace(read_config("graspxl").motions.replay, time_scale=1.0)


@pytest.fixture(scope="module")
def recording_hand(hand):
    """The open hand under the name of the recorded one: what it recorded it must replay exactly."""
    return shape_hand(replace(hand.model, name="mano"), np.zeros(10))


@pytest.fixture(scope="module")
def simulated(hand, objects, config):
    found = synthesise_grasp(hand, objects["can"], config, np.random.default_rng(3))
    assert found.sequence is not None
    return found.sequence


@pytest.fixture(scope="module")
def recorded(simulated, hand, tmp_path_factory):
    root = tmp_path_factory.mktemp("graspxl")
    write_sequence(root, "mano_dataset_1", "large", UID, 1, recorded_arrays(simulated, hand.model, UID))
    return read_sequence(find_sequences(root)[0])


@pytest.fixture(scope="module")
def replayed(recorded, recording_hand, objects, settings):
    return replay(recorded, recording_hand, objects["can"], settings)


def posed(hand, sequence, rows):
    return pose_hand(
        hand,
        orientation_world=sequence.hand_orientation_world[rows],
        hand_pose=sequence.hand_pose[rows],
        translation_world=sequence.hand_translation_world[rows],
        flat_hand_mean=sequence.flat_hand_mean,
    )


def test_hand_and_object_move_as_recorded(simulated, replayed, recording_hand):
    rows = np.linspace(0, len(simulated.hand_pose) - 1, 9).astype(int)
    before, after = (posed(recording_hand, s, rows) for s in (simulated, replayed))
    np.testing.assert_allclose(after.verts_world, before.verts_world, atol=2e-6)  # float32 files
    np.testing.assert_allclose(replayed.T_world_from_obj, simulated.T_world_from_obj, atol=2e-6)


def test_it_says_what_it_is(replayed, recorded):
    assert (replayed.hand_model, replayed.stands_in_for, replayed.source) == ("mano", "", "graspxl")
    assert replayed.licence == "CC-BY-NC-4.0"
    assert replayed.sequence_id == recorded.sequence_id == f"mano_dataset_1/large/{UID}/mano_1"
    assert not replayed.flat_hand_mean
    assert np.isnan(replayed.contact_force_n).all()  # no forces were recorded: not zero, not known


def test_quality_agrees_with_the_simulation_that_made_it(simulated, replayed):
    a, b = simulated.quality, replayed.quality
    assert b.rise_m == pytest.approx(a.rise_m, abs=1e-5)
    assert b.center_distance_m == pytest.approx(a.center_distance_m, abs=1e-5)
    assert b.max_penetration_m == pytest.approx(a.max_penetration_m, abs=1e-3)
    assert b.digits_in_contact >= a.digits_in_contact  # near is less than pressing
    np.testing.assert_allclose(b.digit_distance_m, a.digit_distance_m, atol=2e-3)


def test_the_grasp_frame_is_when_the_hand_starts_to_carry(simulated, replayed):
    assert abs(replayed.grasp_frame - simulated.grasp_frame) < 60
    carried = replayed.T_world_from_obj[replayed.grasp_frame :]
    wrist = replayed.hand_translation_world[replayed.grasp_frame :]
    R_hand = Rotation.from_rotvec(replayed.hand_orientation_world[replayed.grasp_frame :])
    in_hand = R_hand.inv().apply(carried[:, :3, 3] - wrist)
    assert np.linalg.norm(in_hand - in_hand[-1], axis=1).max() < 0.02


def test_distances_are_those_of_the_posed_skin(replayed, recording_hand, objects):
    rows = np.arange(replayed.grasp_frame, len(replayed.hand_pose), 5)
    surface = ObjectSurface(objects["can"])
    distances = signed_distances(
        surface, posed(recording_hand, replayed, rows).verts_world, replayed.T_world_from_obj[rows]
    )
    expected = np.median(digit_distances(recording_hand.model, distances), axis=0)
    np.testing.assert_allclose(replayed.quality.digit_distance_m, expected, atol=1e-4)


def test_a_mesh_file_with_another_origin_and_axes_gives_the_same_world(
    recorded, recording_hand, objects, settings, replayed
):
    """`T_obj_from_file` may turn and shift: points of the object stay where they were recorded."""
    T_obj_from_file = np.eye(4)
    T_obj_from_file[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.2, 1.0]).as_matrix()
    T_obj_from_file[:3, 3] = [0.01, 0.02, -0.03]
    turned = replace(
        objects["can"],
        T_obj_from_file=T_obj_from_file,
        mesh=replace(
            objects["can"].mesh,
            verts_obj=objects["can"].mesh.verts_obj @ T_obj_from_file[:3, :3].T + T_obj_from_file[:3, 3],
        ),
    )
    moved = replay(recorded, recording_hand, turned, settings)
    np.testing.assert_allclose(
        moved.T_world_from_obj, replayed.T_world_from_obj @ invert_transform(T_obj_from_file), atol=1e-9
    )
    assert moved.quality.max_penetration_m == pytest.approx(replayed.quality.max_penetration_m, abs=1e-6)


def test_slow_motion_keeps_the_path_and_the_rate(recorded, recording_hand, objects, settings, replayed):
    slow = replay(recorded, recording_hand, objects["can"], replace(settings, time_scale=2.5))
    assert slow.fps == replayed.fps == 100.0
    assert len(slow.hand_pose) == int((len(replayed.hand_pose) - 1) * 2.5) + 1
    np.testing.assert_allclose(slow.T_world_from_obj[::5], replayed.T_world_from_obj[::2], atol=1e-9)
    assert slow.grasp_frame == pytest.approx(2.5 * replayed.grasp_frame, abs=1)


def test_another_hand_stands_in_and_says_so(simulated, recorded, hand, objects, settings):
    """As recorded by a hand with MANO's rest wrist: it stays a grasp, at the same place."""
    mano_wrist_rest = np.array([0.09566994, 0.00638343, 0.0061863])  # FORMATS 2.2
    shifted = recorded.hand_translation_world + hand.joints_rest[0] - mano_wrist_rest
    sequence = replay(replace(recorded, hand_translation_world=shifted), hand, objects["can"], settings)
    assert (sequence.hand_model, sequence.stands_in_for) == ("openhand", "mano")
    assert sequence.quality.digits_in_contact >= 3
    last = np.array([len(sequence.hand_pose) - 1])
    before, after = (posed(hand, s, last).joints_world for s in (simulated, sequence))
    assert np.linalg.norm(after - before, axis=-1).max() < 0.015


def test_a_hand_that_never_touches_is_refused_with_metrics(recorded, recording_hand, objects, settings):
    far = replace(
        recorded, hand_translation_world=recorded.hand_translation_world + np.array([0.0, 0.3, 0.0])
    )
    with pytest.raises(ReplayError, match=r"0 digits touch can at the end, expected \d .thumb to pinky, mm"):
        replay(far, recording_hand, objects["can"], settings)


def test_a_hand_that_sinks_in_is_refused_with_metrics(recorded, recording_hand, objects, settings):
    strict = replace(settings, max_penetration_m=0.0)
    wrist = recording_hand.joints_rest[0]
    fatter = replace(recording_hand, verts_rest=wrist + 1.05 * (recording_hand.verts_rest - wrist))
    with pytest.raises(ReplayError, match=r"the hand sinks [\d.]+ mm into can, allowed 0 mm"):
        replay(recorded, fatter, objects["can"], strict)


def test_only_the_neutral_right_hand_replays(recorded, hand, objects, settings):
    with pytest.raises(ValueError, match="betas 0"):
        replay(recorded, shape_hand(hand.model, np.ones(10)), objects["can"], settings)


def test_a_rescaled_object_is_refused(recorded, hand, objects, settings):
    scaled = replace(objects["can"], T_obj_from_file=np.diag([0.5, 0.5, 0.5, 1.0]))
    with pytest.raises(ValueError, match="at the size it was recorded with"):
        replay(recorded, hand, scaled, settings)
