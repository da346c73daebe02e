"""The articulated hand moves exactly as the skinned one, for any hand of the layout."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datagen.grasps.hand_body import bone_transforms, build_hand_body, local_rotations
from datagen.grasps.synthesis.physics_world import GraspWorld, WristTarget
from datagen.hands.model import load_open_hand, mirror_hand, pose_hand, shape_hand
from shards.joints import DIGITS


def _random_angles(body, rng, count):
    low = np.array([hinge.low_rad for hinge in body.hinges])
    high = np.array([hinge.high_rad for hinge in body.hinges])
    return rng.uniform(low, high, (count, len(low)))


@pytest.mark.parametrize("side", ["right", "left"])
def test_physics_and_skinning_place_every_joint_alike(side, objects, config):
    rng = np.random.default_rng(0)
    hand = shape_hand(load_open_hand(side), 0.5 * rng.normal(size=10))
    body = build_hand_body(hand)
    world = GraspWorld(body, objects["can"], config)
    for angles in _random_angles(body, rng, 5):
        R = Rotation.random(random_state=int(rng.integers(1000)))
        position = rng.normal(size=3)
        world.reset(
            WristTarget(R_world_from_hand=R.as_matrix(), position_world=position), angles, np.eye(4), None
        )
        world.detect()
        posed = pose_hand(
            hand,
            orientation_world=R.as_rotvec()[None],
            hand_pose=Rotation.from_matrix(local_rotations(body, angles)[1:]).as_rotvec().reshape(1, 45),
            translation_world=(position - body.joints_rest[0])[None],
            flat_hand_mean=True,
        )
        in_physics = world.data.xpos[world.bone_body]
        assert np.abs(in_physics - posed.joints_world[0, :16]).max() < 1e-6
        turned = world.data.xmat[world.bone_body].reshape(16, 3, 3)
        assert np.abs(turned - posed.T_world_from_joint[0, :, :3, :3]).max() < 1e-6


@pytest.mark.parametrize("side", ["right", "left"])
def test_positive_flexion_closes_every_digit(side):
    hand = shape_hand(load_open_hand(side), np.zeros(10))
    body = build_hand_body(hand)
    flexed = np.array([0.6 if hinge.role == "flexion" else 0.0 for hinge in body.hinges])
    rotation, origin = bone_transforms(body, np.stack([np.zeros_like(flexed), flexed]))
    palm = 0.5 * body.joints_rest[[1, 4, 10, 7]].mean(0) - 0.5 * body.joints_rest[0] - 0.04 * body.dorsal
    for digit, pad in zip(DIGITS, body.pads):
        at = origin[:, pad.bone] + rotation[:, pad.bone] @ pad.position_bone
        assert np.linalg.norm(at[1] - palm) < np.linalg.norm(at[0] - palm), digit


def test_the_thumb_axis_does_not_depend_on_the_rest_angle_of_the_thumb(hand):
    """A model whose thumb rests elsewhere gets the same anatomy, turned along."""
    body = build_hand_body(hand)
    turn = Rotation.from_rotvec(body.distal * 0.3).as_matrix()
    pivot = hand.joints_rest[13]
    share = hand.model.weights[:, [13, 14, 15]].sum(1, keepdims=True)
    verts = hand.verts_rest + share * ((hand.verts_rest - pivot) @ turn.T + pivot - hand.verts_rest)
    joints = hand.joints_rest.copy()
    joints[14:16] = (joints[14:16] - pivot) @ turn.T + pivot
    moved = build_hand_body(replace(hand, verts_rest=verts, joints_rest=joints))
    flexion = next(h.axis_bone for h in body.hinges if h.name == "thumb_ip")
    after = next(h.axis_bone for h in moved.hinges if h.name == "thumb_ip")
    assert (turn @ flexion) @ after > np.cos(np.deg2rad(8.0))
    # The reach out of the palm plane stays the same, so the limits shift the other way.
    before, now = (next(h for h in b.hinges if h.name == "thumb_opposition") for b in (body, moved))
    shift = np.rad2deg(now.high_rad - before.high_rad)
    assert abs(abs(shift) - np.rad2deg(0.3)) < 6.0


def test_vertex_order_and_count_do_not_matter(hand):
    order = np.random.default_rng(1).permutation(len(hand.verts_rest))
    back = np.argsort(order)
    model = replace(
        hand.model,
        v_template=hand.model.v_template[order],
        weights=hand.model.weights[order],
        faces=back[hand.model.faces],
        tip_ids=back[hand.model.tip_ids],
    )
    shuffled = build_hand_body(replace(hand, model=model, verts_rest=hand.verts_rest[order]))
    for a, b in zip(build_hand_body(hand).hinges, shuffled.hinges):
        assert a.name == b.name
        assert np.allclose(a.axis_bone, b.axis_bone, atol=1e-6)
        assert np.isclose(a.high_rad, b.high_rad)


def test_the_left_body_is_the_mirror_of_the_right():
    right = load_open_hand("right")
    bodies = [build_hand_body(shape_hand(m, np.zeros(10))) for m in (right, mirror_hand(right))]
    flip = np.array([-1.0, 1.0, 1.0])
    for pad, mirrored in zip(bodies[0].pads, bodies[1].pads):
        assert np.allclose(pad.position_bone * flip, mirrored.position_bone, atol=1e-9)
    assert np.allclose(bodies[0].dorsal * flip, bodies[1].dorsal)
    for a, b in zip(bodies[0].hinges, bodies[1].hinges):
        # A mirrored turn has its axis flipped like a pseudo-vector.
        same = np.allclose(-a.axis_bone * flip, b.axis_bone, atol=1e-6)
        opposite = np.allclose(a.axis_bone * flip, b.axis_bone, atol=1e-6) and a.role == "spread"
        assert same or opposite, a.name
        assert np.isclose(a.low_rad, b.low_rad), a.name
        assert np.isclose(a.high_rad, b.high_rad), a.name


def test_hulls_cover_the_skin_of_the_fingers(hand):
    import trimesh

    body = build_hand_body(hand)
    hulls = [trimesh.convex.convex_hull(hull.verts_bone + hand.joints_rest[hull.bone]) for hull in body.hulls]
    rigid = hand.model.weights[:, 1:].max(1) > 0.6
    verts = hand.verts_rest[rigid]
    outside = np.min(
        [(verts @ h.face_normals.T - (h.face_normals * h.triangles[:, 0]).sum(1)).max(1) for h in hulls],
        axis=0,
    )
    assert outside.max() < 1e-6
