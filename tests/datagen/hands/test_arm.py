"""Forearm and sleeve: closed, continuous with the hand, rigid with the wrist."""

import numpy as np
import pytest
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.spatial.transform import Rotation

from datagen.hands.arm import ARM_SKIN, HAND_SKIN, SLEEVE, ArmStyle, DressedHand, dress_hand, dressed_verts
from datagen.hands.model import PosedHand, load_open_hand, pose_hand, shape_hand

N_FRAMES = 6


def _style(sleeve_start_m: float | None = None, **changes: float) -> ArmStyle:
    values = {
        "length_m": 0.26,
        "girth": 1.0,
        "sleeve_gap_m": 0.004,
        "cuff_m": 0.02,
        "fold_depth_m": 0.003,
        "fold_phase_rad": 1.0,
    }
    return ArmStyle(sleeve_start_m=sleeve_start_m, **(values | changes))


def _dressed(side: str = "right", style: ArmStyle | None = None, seed: int = 0) -> DressedHand:
    model = load_open_hand(side)
    betas = np.random.default_rng(seed).uniform(-1.5, 1.5, model.shapedirs.shape[2])
    return dress_hand(shape_hand(model, betas), style or _style())


def _posed(dressed: DressedHand, seed: int = 1) -> PosedHand:
    rng = np.random.default_rng(seed)
    return pose_hand(
        dressed.shaped,
        orientation_world=rng.normal(size=(N_FRAMES, 3)),
        hand_pose=0.4 * rng.normal(size=(N_FRAMES, 45)),
        translation_world=rng.normal(size=(N_FRAMES, 3)),
        flat_hand_mean=True,
    )


def _rest_verts(dressed: DressedHand) -> np.ndarray:
    return np.concatenate(
        [dressed.shaped.verts_rest, dressed.extra_verts_wrist + dressed.shaped.joints_rest[0]]
    )


def _assert_closed_and_outward(verts: np.ndarray, faces: np.ndarray) -> None:
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    n_verts = len(verts)
    forward = directed[:, 0] * n_verts + directed[:, 1]
    backward = directed[:, 1] * n_verts + directed[:, 0]
    assert len(np.unique(forward)) == len(forward), "an edge is used twice in the same direction"
    assert np.isin(forward, backward).all(), "an edge has a face on one side only"
    a, b, c = np.moveaxis(verts[faces] - verts[faces].mean(axis=(0, 1)), 1, 0)
    assert np.einsum("fi,fi->", a, np.cross(b, c)) > 0.0, "the surface faces inward"


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("start_m", [None, 0.0, 0.05, 0.15])
def test_hand_with_forearm_and_sleeve_are_each_watertight(side: str, start_m: float | None) -> None:
    dressed = _dressed(side, _style(start_m))
    verts = _rest_verts(dressed)
    skin = dressed.face_part != SLEEVE
    _assert_closed_and_outward(verts, dressed.faces[skin])
    assert (start_m is None) == skin.all()
    if start_m is not None:
        _assert_closed_and_outward(verts, dressed.faces[~skin])
    assert dressed.corner_uv.shape == (*dressed.faces.shape, 2)
    assert np.isfinite(dressed.corner_uv).all()


def test_every_face_of_the_hand_but_the_cap_is_kept() -> None:
    dressed = _dressed()
    model = dressed.shaped.model
    kept = dressed.faces[dressed.face_part == HAND_SKIN]
    dropped = {tuple(face) for face in model.faces.tolist()} - {tuple(face) for face in kept.tolist()}
    assert len(dropped) == len(model.faces) - len(kept)
    beyond = np.setdiff1d(np.unique(list(dropped)), model.wrist_loop)
    assert len(dropped) == len(model.wrist_loop) - 2 + 2 * len(beyond)  # Euler: they fill the ring, no more
    assert dressed.n_hand_verts == len(dressed.shaped.verts_rest)


def test_forearm_begins_on_the_wrist_ring_without_a_gap_or_a_crease() -> None:
    dressed = _dressed()
    verts = _rest_verts(dressed)
    ring = dressed.shaped.model.wrist_loop
    hand = dressed.faces[dressed.face_part == HAND_SKIN]
    arm = dressed.faces[dressed.face_part == ARM_SKIN]
    assert set(np.intersect1d(hand, arm)) == set(ring.tolist())
    turn = _normals_at(verts, hand, ring), _normals_at(verts, arm, ring)
    angle_deg = np.degrees(np.arccos(np.clip((turn[0] * turn[1]).sum(axis=1), -1.0, 1.0)))
    assert np.median(angle_deg) < 8.0
    assert angle_deg.max() < 30.0


def _normals_at(verts: np.ndarray, faces: np.ndarray, at: np.ndarray) -> np.ndarray:
    a, b, c = np.moveaxis(verts[faces], 1, 0)
    total = np.zeros_like(verts)
    for corner in range(3):
        np.add.at(total, faces[:, corner], np.cross(b - a, c - a))
    return total[at] / np.linalg.norm(total[at], axis=1, keepdims=True)


def test_texture_continues_across_the_ring() -> None:
    dressed = _dressed()
    ring = set(dressed.shaped.model.wrist_loop.tolist())
    hand, arm = (dressed.face_part == part for part in (HAND_SKIN, ARM_SKIN))
    corners = [
        (dressed.faces[part].reshape(-1), dressed.corner_uv[part].reshape(-1, 2)) for part in (hand, arm)
    ]
    (hand_verts, hand_uv), (arm_verts, arm_uv) = corners
    at_ring = [i for i, vert in enumerate(arm_verts.tolist()) if vert in ring]
    gap = [np.linalg.norm(hand_uv[hand_verts == arm_verts[i]] - arm_uv[i], axis=1).min() for i in at_ring]
    assert np.max(gap) < 6.0 / 1024


@pytest.mark.parametrize("side", ["right", "left"])
def test_arm_is_rigid_with_the_wrist(side: str) -> None:
    dressed = _dressed(side, _style(0.05))
    posed = _posed(dressed)
    verts = dressed_verts(dressed, posed)
    np.testing.assert_array_equal(verts[:, : dressed.n_hand_verts], posed.verts_world)
    T = posed.T_world_from_joint[:, 0]
    extra_world = np.einsum("fab,eb->fea", T[:, :3, :3], dressed.extra_verts_wrist) + T[:, None, :3, 3]
    np.testing.assert_allclose(verts[:, dressed.n_hand_verts :], extra_world, atol=1e-12)


def test_ring_stays_with_the_arm_when_the_fingers_move() -> None:
    """The ring is skinned by the hand model; a strong thumb moves it by less than the eye sees."""
    dressed = _dressed()
    posed = _posed(dressed)
    model, wrist = dressed.shaped.model, dressed.shaped.joints_rest[0]
    T = posed.T_world_from_joint[:, 0]
    ring_rest = dressed.shaped.verts_rest[model.wrist_loop] - wrist
    rigid = np.einsum("fab,eb->fea", T[:, :3, :3], ring_rest) + T[:, None, :3, 3]
    assert np.linalg.norm(posed.verts_world[:, model.wrist_loop] - rigid, axis=-1).max() < 0.002


def _first_hit(verts: np.ndarray, faces: np.ndarray, origins: np.ndarray, rays: np.ndarray) -> np.ndarray:
    scene = EmbreeScene(robust=True)
    mesh = TriangleMesh(scene, verts.astype(np.float32), faces.astype(np.int32))
    found = scene.run(origins.astype(np.float32), rays.astype(np.float32))
    del mesh
    return np.asarray(found)


@pytest.mark.parametrize("seed", range(4))
def test_no_ray_gets_between_arm_and_sleeve(seed: int) -> None:
    """Rays into the cuff from the side of the hand end on the front of a face, never on a back."""
    rng = np.random.default_rng(seed)
    style = _style(rng.uniform(0.0, 0.12), sleeve_gap_m=0.009, fold_phase_rad=rng.uniform(0.0, 6.28))
    dressed = _dressed(style=style, seed=seed)
    verts = _rest_verts(dressed)
    ring = verts[dressed.shaped.model.wrist_loop]
    axis = Rotation.from_rotvec(0.15 * rng.normal(size=(400, 3))).apply([1.0, 0.0, 0.0])
    in_front = ring.mean(axis=0) - np.array([0.25, 0.0, 0.0])
    origins = in_front + rng.uniform(-0.06, 0.06, (400, 3))
    face = _first_hit(verts, dressed.faces, origins, axis)
    hit = face >= 0
    a, b, c = np.moveaxis(verts[dressed.faces[face[hit]]], 1, 0)
    assert hit.sum() > 100
    assert (np.einsum("ri,ri->r", np.cross(b - a, c - a), axis[hit]) < 1e-12).all()


@pytest.mark.parametrize("girth", [0.85, 1.2])
def test_sleeve_stays_outside_the_arm(girth: float) -> None:
    dressed = _dressed(style=_style(0.03, girth=girth))
    verts = _rest_verts(dressed)
    arm = np.unique(dressed.faces[dressed.face_part == ARM_SKIN])
    axis = np.array([1.0, 0.0, 0.0])
    points = verts[arm]
    behind = (points - verts[dressed.shaped.model.wrist_loop].mean(axis=0)) @ axis > 0.045
    sleeve = dressed.faces[dressed.face_part == SLEEVE]
    outward = points[behind] - points.mean(axis=0)
    outward -= np.outer(outward @ axis, axis)
    away = outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    assert (_first_hit(verts, sleeve, points[behind], away) >= 0).all()
    inward = points[behind] - 0.002 * away
    assert (_first_hit(verts, sleeve, inward, -away) >= 0).all()


def test_dressing_is_deterministic_and_the_phase_moves_the_folds() -> None:
    first, second = _dressed(style=_style(0.04)), _dressed(style=_style(0.04))
    np.testing.assert_array_equal(first.extra_verts_wrist, second.extra_verts_wrist)
    np.testing.assert_array_equal(first.corner_uv, second.corner_uv)
    other = _dressed(style=_style(0.04, fold_phase_rad=2.5))
    assert np.abs(other.extra_verts_wrist - first.extra_verts_wrist).max() > 5e-4


def test_a_sleeve_beyond_the_arm_is_refused() -> None:
    with pytest.raises(ValueError, match=r"sleeve_start_m is 0.3; expected 0 .. length_m - cuff_m"):
        _dressed(style=_style(0.3))
