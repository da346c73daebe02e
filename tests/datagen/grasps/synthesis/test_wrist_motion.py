import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.grasps.hand_body import build_hand_body
from datagen.grasps.synthesis.physics_world import WristTarget
from datagen.grasps.synthesis.wrist_motion import minimum_jerk, plan_turns, straight


def test_minimum_jerk_starts_and_ends_at_rest():
    s = minimum_jerk(400)
    speed, last = np.diff(s), s[-1]
    assert last == 1.0
    assert (speed > 0).all()
    assert speed[0] < 1e-3 * speed.max()
    assert speed[-1] < 1e-3 * speed.max()


def test_straight_ends_at_the_shift():
    start = WristTarget(R_world_from_hand=np.eye(3), position_world=np.ones(3))
    assert np.allclose(straight(start, np.array([0, 0, 0.2]), 50).positions_world[-1], [1, 1, 1.2])


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_turns_join_up_and_keep_every_carried_point_above_the_table(hand, config, seed):
    rng = np.random.default_rng(seed)
    start = WristTarget(R_world_from_hand=np.eye(3), position_world=np.array([0.1, 0.0, 0.25]))
    pivot = np.array([0.0, 0.0, 0.25])
    carried = pivot + rng.normal(size=(30, 3)) * 0.07
    carried[:, 2] = np.maximum(carried[:, 2], 0.02)
    body = build_hand_body(hand)
    paths = plan_turns(body, start, pivot, carried, config, 0.002, rng)
    R_before, at = start.R_world_from_hand, start.position_world
    for path in paths:
        assert np.linalg.norm(path.positions_world[0] - at) < 0.001
        assert np.linalg.norm(np.diff(path.positions_world, axis=0), axis=1).max() < 0.01
        R_before, at = path.R_world_from_hand[-1], path.positions_world[-1]
        # Hand and object move as one: carry the points along with the wrist.
        rigid = (carried - start.position_world) @ start.R_world_from_hand
        for R, position in zip(path.R_world_from_hand[::20], path.positions_world[::20]):
            assert (rigid @ R.T + position)[:, 2].min() > -0.005
    assert np.allclose(R_before @ R_before.T, np.eye(3), atol=1e-9)
