"""The hand's forward model against independent implementations and its own symmetries."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from datagen.hands.model import (
    PARENTS,
    HandModel,
    PosedHand,
    ShapedHand,
    load_open_hand,
    mirror_axis_angle,
    mirror_hand,
    pose_hand,
    shape_hand,
)

SEEDS = st.integers(0, 2**32 - 1)


def random_pose(seed: int, n_frames: int = 2) -> dict[str, Float[np.ndarray, "..."]]:
    rng = np.random.default_rng(seed)
    return {
        "orientation_world": rng.normal(size=(n_frames, 3)),
        "hand_pose": 0.4 * rng.normal(size=(n_frames, 45)),
        "translation_world": rng.normal(size=(n_frames, 3)),
    }


def random_shape(seed: int, model: HandModel) -> ShapedHand:
    return shape_hand(model, np.random.default_rng(seed).normal(size=10))


def skinned_vertex_by_vertex(
    hand: ShapedHand, axis_angle: Float[np.ndarray, "16 3"], translation: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "vert 3"]:
    """The textbook formula, one vertex and one joint at a time."""
    model = hand.model
    turn = [Rotation.from_rotvec(a).as_matrix() for a in axis_angle]
    chain: list[np.ndarray] = []
    for j, parent in enumerate(PARENTS):
        local = np.eye(4)
        local[:3, :3] = turn[j]
        local[:3, 3] = hand.joints_rest[j] - (hand.joints_rest[parent] if j else 0.0)
        chain.append(chain[parent] @ local if j else local)
    result = np.zeros_like(hand.verts_rest)
    for v, rest in enumerate(hand.verts_rest):
        offset = np.zeros(3)
        for j in range(1, 16):
            for row in range(3):
                for column in range(3):
                    difference = turn[j][row, column] - float(row == column)
                    offset += model.posedirs[v, :, 9 * (j - 1) + 3 * row + column] * difference
        for j in np.flatnonzero(model.weights[v]):
            from_joint = np.append(rest + offset - hand.joints_rest[j], 1.0)
            result[v] += model.weights[v, j] * (chain[j] @ from_joint)[:3]
    return result + translation


def test_skinning_equals_a_loop_over_single_vertices() -> None:
    hand = random_shape(1, load_open_hand())
    pose = random_pose(2, n_frames=1)
    posed = pose_hand(hand, **pose, flat_hand_mean=True)
    axis_angle = np.concatenate([pose["orientation_world"], pose["hand_pose"].reshape(15, 3)])
    expected = skinned_vertex_by_vertex(hand, axis_angle, pose["translation_world"][0])
    np.testing.assert_allclose(posed.verts_world[0], expected, atol=1e-12)


def test_the_rest_pose_is_the_shaped_hand() -> None:
    hand = random_shape(3, load_open_hand())
    zero = np.zeros((1, 3))
    posed = pose_hand(
        hand, orientation_world=zero, hand_pose=np.zeros((1, 45)), translation_world=zero, flat_hand_mean=True
    )
    np.testing.assert_allclose(posed.verts_world[0], hand.verts_rest, atol=1e-12)
    np.testing.assert_allclose(posed.joints_world[0, :16], hand.joints_rest, atol=1e-12)
    np.testing.assert_allclose(posed.joints_world[0, 16:], hand.verts_rest[hand.model.tip_ids], atol=1e-12)


def test_offsets_from_the_mean_pose_equal_the_full_pose() -> None:
    hand = random_shape(4, load_open_hand())
    pose = random_pose(5)
    full = pose | {"hand_pose": pose["hand_pose"] + hand.model.hands_mean}
    assert np.abs(hand.model.hands_mean).max() > 0.1
    _assert_same(pose_hand(hand, **pose, flat_hand_mean=False), pose_hand(hand, **full, flat_hand_mean=True))


@settings(max_examples=25)
@given(seed=SEEDS)
def test_turning_the_wrist_turns_the_whole_hand_about_the_wrist(seed: int) -> None:
    hand = random_shape(seed, load_open_hand())
    pose = random_pose(seed + 1, n_frames=1)
    turn = Rotation.from_rotvec(np.random.default_rng(seed + 2).normal(size=3))
    turned = pose | {
        "orientation_world": (turn * Rotation.from_rotvec(pose["orientation_world"])).as_rotvec(),
    }
    before = pose_hand(hand, **pose, flat_hand_mean=True)
    after = pose_hand(hand, **turned, flat_hand_mean=True)
    wrist = hand.joints_rest[0] + pose["translation_world"][0]
    np.testing.assert_allclose(
        after.verts_world[0], turn.apply(before.verts_world[0] - wrist) + wrist, atol=1e-9
    )
    np.testing.assert_allclose(
        after.joints_world[0], turn.apply(before.joints_world[0] - wrist) + wrist, atol=1e-9
    )


@settings(max_examples=25)
@given(seed=SEEDS)
def test_the_mirrored_hand_in_the_mirrored_pose_is_the_mirror_image(seed: int) -> None:
    right, left = load_open_hand("right"), load_open_hand("left")
    pose = random_pose(seed)
    flip = np.array([-1.0, 1.0, 1.0])
    mirrored = {
        "orientation_world": mirror_axis_angle(pose["orientation_world"]),
        "hand_pose": mirror_axis_angle(pose["hand_pose"].reshape(2, 15, 3)).reshape(2, 45),
        "translation_world": pose["translation_world"] * flip,
    }
    for flat_hand_mean in (True, False):
        image = pose_hand(random_shape(seed, right), **pose, flat_hand_mean=flat_hand_mean)
        other = pose_hand(random_shape(seed, left), **mirrored, flat_hand_mean=flat_hand_mean)
        np.testing.assert_allclose(other.verts_world, image.verts_world * flip, atol=1e-9)
        np.testing.assert_allclose(other.joints_world, image.joints_world * flip, atol=1e-9)


def test_mirroring_twice_gives_the_same_hand() -> None:
    hand = load_open_hand()
    again = mirror_hand(mirror_hand(hand))
    assert again.side == "right"
    for name in ("v_template", "shapedirs", "posedirs", "faces", "hands_mean", "corner_uv", "wrist_loop"):
        np.testing.assert_array_equal(getattr(again, name), getattr(hand, name))


def test_too_many_shape_coefficients_are_refused() -> None:
    with pytest.raises(ValueError, match="has 10 shape coefficients, found 11"):
        shape_hand(load_open_hand(), np.zeros(11))


def _assert_same(a: PosedHand, b: PosedHand) -> None:
    np.testing.assert_allclose(a.verts_world, b.verts_world, atol=1e-12)
    np.testing.assert_allclose(a.joints_world, b.joints_world, atol=1e-12)
