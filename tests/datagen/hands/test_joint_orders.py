"""The order of the joints against the hand itself."""

import numpy as np

from datagen.hands.model import PARENTS, load_open_hand, pose_hand, shape_hand
from shards.joints import OPENPOSE_ORDER, reordered_joints


def test_in_openpose_order_each_joint_hangs_on_the_one_before_it() -> None:
    hand = shape_hand(load_open_hand(), np.zeros(10))
    zero = np.zeros((1, 3))
    posed = pose_hand(
        hand, orientation_world=zero, hand_pose=np.zeros((1, 45)), translation_world=zero, flat_hand_mean=True
    )
    joints = reordered_joints(posed.joints_world, OPENPOSE_ORDER)[0]
    for start in range(1, 21, 4):
        lengths = np.linalg.norm(np.diff(joints[start : start + 4], axis=0), axis=1)
        assert (lengths > 0.012).all()
        assert (lengths < 0.06).all()
        assert PARENTS[OPENPOSE_ORDER[start]] == 0
        assert [PARENTS[OPENPOSE_ORDER[start + k]] for k in (1, 2)] == list(OPENPOSE_ORDER[start : start + 2])
