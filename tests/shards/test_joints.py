"""The order of the joints is fixed; the other orders are permutations with the other side's names."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shards.joints import (
    DIGIT_JOINTS,
    DIGITS,
    HO3D_ORDER,
    JOINTS,
    MANO_JOINTS,
    MEDIAPIPE_ORDER,
    OPENPOSE_ORDER,
    joint_names,
    reordered_joints,
    reordered_joints_back,
)

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


def test_rows_are_mano_joints_then_the_tips_thumb_to_pinky_as_in_ho3d() -> None:
    assert DIGITS == ("thumb", "index", "middle", "ring", "pinky")
    assert JOINTS[:16] == MANO_JOINTS
    assert joint_names(HO3D_ORDER) == JOINTS
    assert [JOINTS.index(name) for name in ("wrist", "index1", "middle1", "pinky1", "ring1", "thumb1")] == [
        0, 1, 4, 7, 10, 13,
    ]  # fmt: skip
    assert JOINTS[16:] == tuple(f"{digit}_tip" for digit in DIGITS)


def test_digits_have_their_own_joints_from_the_base_outward() -> None:
    for digit, joints in DIGIT_JOINTS.items():
        assert joint_names(joints) == (f"{digit}1", f"{digit}2", f"{digit}3")


def test_openpose_order_is_the_published_one() -> None:
    assert OPENPOSE_ORDER == (0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20)


@pytest.mark.parametrize("order", [OPENPOSE_ORDER, MEDIAPIPE_ORDER])
def test_names_follow_each_digit_from_base_to_tip(order: tuple[int, ...]) -> None:
    translated = ["wrist"]
    for name in MEDIAPIPE_NAMES[1:]:
        digit, joint = name.split("_")[0].lower(), name.split("_")[-1]
        number = ("CMC", "MCP", "IP") if digit == "thumb" else ("MCP", "PIP", "DIP")
        translated.append(f"{digit}_tip" if joint == "TIP" else f"{digit}{1 + number.index(joint)}")
    assert list(joint_names(order)) == translated
