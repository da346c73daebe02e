"""Resampling keeps the motion: rotations as rotations, instants in place."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datagen.grasps.recorded.resample import resample_sequence
from datagen.grasps.sequence import GraspQuality, GraspSequence

QUALITY = GraspQuality(
    rise_m=0.2,
    center_distance_m=0.05,
    max_penetration_m=0.001,
    digits_in_contact=4,
    slip_lift_m=0.001,
    slip_manipulation_m=0.001,
    contact_force_n=10.0,
    attempts=1,
    digit_distance_m=np.zeros(5),
)


def spinning(frames: int, fps: float, speed_rad_s: float) -> GraspSequence:
    """Everything turns about its own fixed axis at constant speed, far through +-pi."""
    t = np.arange(frames) / fps
    axes = np.random.default_rng(0).normal(size=(17, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    turns = [Rotation.from_rotvec(t[:, None] * speed_rad_s * axis) for axis in axes]
    T = np.tile(np.eye(4), (frames, 1, 1))
    T[:, :3, :3] = turns[16].as_matrix()
    T[:, 0, 3] = t
    return GraspSequence(
        sequence_id="spin",
        object_uid="can",
        hand_model="openhand",
        side="right",
        fps=fps,
        flat_hand_mean=True,
        betas=np.zeros(10),
        hand_orientation_world=turns[15].as_rotvec(),
        hand_pose=np.concatenate([turn.as_rotvec() for turn in turns[:15]], 1),
        hand_translation_world=np.stack([t, -t, 0 * t], 1),
        T_world_from_obj=T,
        contact_force_n=np.tile(t[:, None], (1, 5)),
        grasp_frame=frames // 2,
        quality=QUALITY,
    )


@pytest.mark.parametrize("fps", [7.3, 30.0, 60.0, 240.0])
def test_constant_spin_stays_constant_through_the_wrap(fps):
    coarse = resample_sequence(spinning(300, 100.0, 5.0), fps)
    exact = spinning(len(coarse.hand_pose), fps, 5.0)
    for name in ("hand_orientation_world", "hand_pose"):
        got, want = getattr(coarse, name).reshape(-1, 3), getattr(exact, name).reshape(-1, 3)
        error = (Rotation.from_rotvec(got).inv() * Rotation.from_rotvec(want)).magnitude()
        assert error.max() < 1e-9
    assert np.allclose(coarse.T_world_from_obj, exact.T_world_from_obj, atol=1e-9)
    assert np.allclose(coarse.hand_translation_world, exact.hand_translation_world)
    assert np.allclose(coarse.contact_force_n, exact.contact_force_n)


def test_same_rate_is_the_identity():
    sequence = spinning(120, 100.0, 3.0)
    same = resample_sequence(sequence, 100.0)
    assert np.allclose(same.T_world_from_obj, sequence.T_world_from_obj)
    assert same.grasp_frame == sequence.grasp_frame


def test_the_grasp_stays_at_its_instant():
    sequence = spinning(301, 100.0, 1.0)  # grasp at 1.5 s
    assert resample_sequence(sequence, 30.0).grasp_frame == 45
    assert resample_sequence(sequence, 30.0, first_s=1.0).grasp_frame == 15
    assert resample_sequence(sequence, 30.0, first_s=2.0).grasp_frame == 0


def test_a_presented_object_is_drawn_only_once_held():
    sequence = replace(spinning(301, 100.0, 1.0), start="held", first_drawn_frame=150)
    clip = resample_sequence(sequence, 10.0)
    assert clip.first_drawn_frame == 0
    assert clip.grasp_frame == 0
    assert np.isclose(clip.hand_translation_world[0, 0], 1.5)


def test_too_long_a_clip_says_what_fits():
    with pytest.raises(ValueError, match="1 to 31 do"):
        resample_sequence(spinning(301, 100.0, 1.0), 10.0, frames=32)
    with pytest.raises(ValueError, match="lasts 0 to 3"):
        resample_sequence(spinning(301, 100.0, 1.0), 10.0, first_s=4.0)
    with pytest.raises(ValueError, match="positive"):
        resample_sequence(spinning(301, 100.0, 1.0), 0.0)
