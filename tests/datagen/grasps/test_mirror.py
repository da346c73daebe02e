"""The mirrored motion of the mirrored hand and object is the mirror image, vertex by vertex."""

from dataclasses import replace

import numpy as np
import pytest

from datagen.grasps.mirror import mirrored_sequence
from datagen.grasps.sequence import TableEdge
from datagen.hands.model import ShapedHand, mirror_hand, pose_hand, shape_hand
from datagen.objects.asset.mirror import mirrored_asset
from shards.geometry import transform_points
from tests.datagen.grasps.recorded.test_resample import spinning

FLIP = np.array([-1.0, 1.0, 1.0])


def posed(hand: ShapedHand, sequence):
    return pose_hand(
        hand,
        orientation_world=sequence.hand_orientation_world,
        hand_pose=sequence.hand_pose,
        translation_world=sequence.hand_translation_world,
        flat_hand_mean=sequence.flat_hand_mean,
    )


@pytest.mark.parametrize("flat_hand_mean", [True, False])
def test_hand_and_object_are_mirror_images(hand, objects, flat_hand_mean):
    obj = objects["box"]
    shaped = shape_hand(hand.model, np.random.default_rng(0).normal(size=10))
    sequence = replace(
        spinning(20, 100.0, 3.0),
        flat_hand_mean=flat_hand_mean,
        table_edge=TableEdge(point_xy_m=(0.1, 0.2), outward_xy=(0.6, 0.8)),
    )
    mirrored = mirrored_sequence(sequence, "box@mirrored")
    left = shape_hand(mirror_hand(hand.model), shaped.betas)
    assert (mirrored.side, mirrored.object_uid) == ("left", "box@mirrored")
    right_posed, left_posed = posed(shaped, sequence), posed(left, mirrored)
    np.testing.assert_allclose(left_posed.verts_world, right_posed.verts_world * FLIP, atol=1e-9)
    np.testing.assert_allclose(left_posed.joints_world, right_posed.joints_world * FLIP, atol=1e-9)
    verts = np.broadcast_to(obj.mesh.verts_obj, (20, *obj.mesh.verts_obj.shape))
    mirror_verts = np.broadcast_to(mirrored_asset(obj).mesh.verts_obj, verts.shape)
    np.testing.assert_allclose(
        transform_points(mirrored.T_world_from_obj, mirror_verts),
        transform_points(sequence.T_world_from_obj, verts) * FLIP,
        atol=1e-9,
    )
    assert mirrored.table_edge == TableEdge(point_xy_m=(-0.1, 0.2), outward_xy=(-0.6, 0.8))
    assert np.linalg.det(mirrored.T_world_from_obj[:, :3, :3]) == pytest.approx(np.ones(20))


def test_twice_mirrored_is_the_motion_itself():
    sequence = spinning(20, 100.0, 3.0)
    twice = mirrored_sequence(mirrored_sequence(sequence, "a"), sequence.object_uid)
    for name in ("hand_orientation_world", "hand_pose", "hand_translation_world", "T_world_from_obj"):
        np.testing.assert_array_equal(getattr(twice, name), getattr(sequence, name))
    assert twice.side == sequence.side
