"""Joint orders: permutations whose names are what the other side calls its joints."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.hands.joint_orders import (
    HO3D_ORDER,
    MEDIAPIPE_ORDER,
    OPENPOSE_ORDER,
    joint_names,
    reordered_joints,
    reordered_joints_back,
)
from datagen.hands.model import DIGITS, JOINT_NAMES, PARENTS, load_open_hand, pose_hand, shape_hand

ORDERS = {"openpose": OPENPOSE_ORDER, "mediapipe": MEDIAPIPE_ORDER, "ho3d": HO3D_ORDER}
# MediaPipe's joints of a finger from base to tip; the thumb's are called CMC, MCP, IP, TIP.
MEDIAPIPE_NAMES = [
    "WRIST",
    *(f"THUMB_{joint}" for joint in ("CMC", "MCP", "IP", "TIP")),
    *(
        f"{finger}_{joint}"
        for finger in ("INDEX_FINGER", "MIDDLE_FINGER", "RING_FINGER", "PINKY")
        for joint in ("MCP", "PIP", "DIP", "TIP")
    ),
]


@given(order=st.sampled_from(sorted(ORDERS)), seed=st.integers(0, 2**32 - 1))
def test_orders_are_permutations_and_can_be_undone(order: str, seed: int) -> None:
    assert sorted(ORDERS[order]) == list(range(21))
    joints = np.random.default_rng(seed).normal(size=(2, 21, 3))
    there = reordered_joints(joints, ORDERS[order])
    np.testing.assert_array_equal(there[:, 5], joints[:, ORDERS[order][5]])
    np.testing.assert_array_equal(reordered_joints_back(there, ORDERS[order]), joints)


def test_ho3d_is_mano_with_the_tips_thumb_to_pinky() -> None:
    assert joint_names(HO3D_ORDER) == (*JOINT_NAMES, *(f"{digit}_tip" for digit in DIGITS))


@pytest.mark.parametrize("order", [OPENPOSE_ORDER, MEDIAPIPE_ORDER])
def test_names_follow_each_digit_from_base_to_tip(order: tuple[int, ...]) -> None:
    translated = ["wrist"]
    for name in MEDIAPIPE_NAMES[1:]:
        digit, joint = name.split("_")[0].lower(), name.split("_")[-1]
        number = ("CMC", "MCP", "IP") if digit == "thumb" else ("MCP", "PIP", "DIP")
        translated.append(f"{digit}_tip" if joint == "TIP" else f"{digit}{1 + number.index(joint)}")
    assert list(joint_names(order)) == translated


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
