"""MANO files of the official layout: every number, both hands, the wrist, equality with smplx."""

import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import sparse

from datagen.hands.arm import SLEEVE, ArmStyle, dress_hand
from datagen.hands.mano import find_mano, load_mano
from datagen.hands.model import (
    HandModel,
    load_open_hand,
    mirror_hand,
    pose_hand,
    shape_hand,
)
from datagen.input_error import InputError
from datagen.restricted_pickle import load_restricted_pickle
from shards.joints import DIGITS, MANO_JOINTS
from tests.datagen.hands.official_files import (
    left_faces_in_own_order,
    mano_data,
    python2_pickle,
    uncapped,
    write_mano,
)

SAME = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "faces", "parents", "hands_mean")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mano")
    write_mano(path)
    return path


@pytest.fixture(scope="module")
def open_right() -> HandModel:
    return uncapped(load_open_hand())


@pytest.fixture(scope="module")
def hands(folder: Path) -> dict[str, HandModel]:
    return {"right": load_mano(folder, "right"), "left": load_mano(folder / "MANO_LEFT.pkl", "left")}


def test_every_number_of_the_file_arrives(hands: dict[str, HandModel], open_right: HandModel) -> None:
    for side, expected in (("right", open_right), ("left", left_faces_in_own_order(open_right))):
        model = hands[side]
        assert (model.name, model.side) == ("mano", side)
        for name in SAME:
            np.testing.assert_array_equal(getattr(model, name), getattr(expected, name), err_msg=name)
        assert model.shapedirs.shape[2] == 10, "chumpy's selection out of twenty"


def test_plain_files_and_untouched_right_hands_read_the_same(
    hands: dict[str, HandModel], tmp_path: Path
) -> None:
    write_mano(tmp_path, plain=True)
    for side in ("right", "left"):
        plain = load_mano(tmp_path, side)
        for name in (*SAME, "tip_ids", "corner_uv", "wrist_loop"):
            np.testing.assert_array_equal(getattr(plain, name), getattr(hands[side], name), err_msg=name)


@pytest.mark.parametrize("left_bug", [True, False])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_left_shape_directions_are_mended_only_when_they_are_wrong(
    left_bug: bool, sign: float, open_right: HandModel, tmp_path: Path
) -> None:
    """Whatever the sign of the coefficients."""
    right = replace(open_right, shapedirs=sign * open_right.shapedirs)
    write_mano(tmp_path, model=right, left_bug=left_bug)
    written = load_restricted_pickle(tmp_path / "MANO_LEFT.pkl")["shapedirs"]
    left = load_mano(tmp_path, "left")
    np.testing.assert_array_equal(left.shapedirs, mirror_hand(right).shapedirs)
    assert (np.abs(written - left.shapedirs).max() > 0.001) == left_bug
    np.testing.assert_array_equal(load_mano(tmp_path, "right").shapedirs, right.shapedirs)


def test_shape_directions_without_a_clear_sign_are_refused(open_right: HandModel, tmp_path: Path) -> None:
    shapedirs = open_right.shapedirs.copy()
    shapedirs[:, 0] = 0.0
    write_mano(tmp_path, model=replace(open_right, shapedirs=shapedirs))
    assert load_mano(tmp_path, "right").side == "right"
    with pytest.raises(InputError, match=r"length and breadth of the hand correlate by 0\.00"):
        load_mano(tmp_path, "left")


@pytest.mark.parametrize("place", ["", "models", "mano", "mano_v1_2/models", "models/mano"])
def test_files_are_found_where_the_archives_put_them(place: str, tmp_path: Path) -> None:
    assert find_mano(tmp_path, "right") is None
    (tmp_path / place).mkdir(parents=True, exist_ok=True)
    path = tmp_path / place / "MANO_RIGHT.pkl"
    path.touch()
    assert find_mano(tmp_path, "right") == path
    assert find_mano(tmp_path, "left") is None
    with pytest.raises(InputError, match=r"the folder has no MANO_LEFT\.pkl"):
        load_mano(tmp_path, "left")
    with pytest.raises(InputError, match=r"MANO_RIGHT\.pkl: the file is empty"):
        load_mano(tmp_path, "right")


def test_tips_found_from_the_shape_are_those_of_the_open_hand(hands: dict[str, HandModel]) -> None:
    expected = uncapped(load_open_hand()).tip_ids
    for model in hands.values():
        gap = np.linalg.norm(model.v_template[model.tip_ids] - model.v_template[expected], axis=1)
        assert gap.max() < 0.003


def test_meshes_of_778_vertices_have_the_published_tips(open_right: HandModel, tmp_path: Path) -> None:
    """Vertex numbers of the open hand changed so that the published ones are on the last bones."""
    published = [744, 320, 443, 554, 671]
    bones = [3 * k for k in (5, 1, 2, 4, 3)]
    model = _with_778_verts(open_right)
    bone_of = model.weights.argmax(axis=1)
    order = np.arange(778)
    for place, bone in zip(published, bones):
        have = next(i for i in np.flatnonzero(bone_of[order] == bone) if i not in published)
        order[[place, have]] = order[[have, place]]
    write_mano(tmp_path, model=_renumbered(model, order), sides=["right"])
    assert load_mano(tmp_path, "right").tip_ids.tolist() == published
    write_mano(tmp_path, model=model, sides=["right"])
    read = load_mano(tmp_path, "right")
    assert read.tip_ids.tolist() != published
    assert read.weights[read.tip_ids].argmax(axis=1).tolist() == bones


def _with_778_verts(model: HandModel) -> HandModel:
    """The hand decimated, and single vertices added to make up the number."""
    import fast_simplification

    verts, faces = fast_simplification.simplify(
        model.v_template.astype(np.float32), model.faces.astype(np.int32), target_count=1500
    )
    nearest = np.linalg.norm(verts[:, None] - model.v_template, axis=-1).argmin(axis=1)
    assert len(verts) >= 700
    nearest = np.concatenate([nearest, np.full(778 - len(verts), int(model.weights[:, 0].argmax()))])
    verts = model.v_template[nearest]
    return replace(
        model,
        v_template=verts,
        shapedirs=model.shapedirs[nearest],
        posedirs=model.posedirs[nearest],
        J_regressor=_regressor(verts, model.J_regressor @ model.v_template),
        weights=model.weights[nearest],
        faces=faces.astype(np.int64),
        tip_ids=np.arange(5),
        corner_uv=np.zeros((len(faces), 3, 2)),
    )


def _regressor(verts: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Rows that give the joints as affine combinations of the vertices."""
    homogeneous = np.concatenate([verts, np.ones((len(verts), 1))], axis=1)
    return np.concatenate([joints, np.ones((16, 1))], axis=1) @ np.linalg.pinv(homogeneous)


def _renumbered(model: HandModel, order: np.ndarray) -> HandModel:
    return replace(
        model,
        v_template=model.v_template[order],
        shapedirs=model.shapedirs[order],
        posedirs=model.posedirs[order],
        J_regressor=model.J_regressor[:, order],
        weights=model.weights[order],
        faces=np.argsort(order)[model.faces],
    )


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("sleeve_start_m", [None, 0.05])
def test_a_forearm_closes_the_wrist_and_faces_outward(
    side: str, sleeve_start_m: float | None, hands: dict[str, HandModel]
) -> None:
    style = ArmStyle(
        length_m=0.26,
        girth=1.0,
        sleeve_start_m=sleeve_start_m,
        sleeve_gap_m=0.004,
        cuff_m=0.02,
        fold_depth_m=0.003,
        fold_phase_rad=1.0,
    )
    shaped = shape_hand(hands[side], np.linspace(-1.0, 1.0, 10))
    dressed = dress_hand(shaped, style)
    verts = np.concatenate([shaped.verts_rest, dressed.extra_verts_wrist + shaped.joints_rest[0]])
    for part in (dressed.face_part != SLEEVE, dressed.face_part == SLEEVE):
        faces = dressed.faces[part]
        if len(faces):
            directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
            pairs = {tuple(edge) for edge in directed.tolist()}
            assert len(pairs) == len(directed)
            assert pairs == {(b, a) for a, b in pairs}
            a, b, c = np.moveaxis(verts[faces] - verts[faces].mean(axis=(0, 1)), 1, 0)
            assert np.einsum("fi,fi->", a, np.cross(b, c)) > 0.0
    assert np.isfinite(dressed.corner_uv).all()


def test_the_loop_runs_as_that_of_the_open_hand(hands: dict[str, HandModel]) -> None:
    for side, model in hands.items():
        expected = uncapped(load_open_hand(side)).wrist_loop.tolist()
        start = expected.index(model.wrist_loop[0])
        assert model.wrist_loop.tolist() == expected[start:] + expected[:start]


def _edited(change: Callable[[dict[str, Any]], object], tmp_path: Path, model: HandModel) -> Path:
    data = mano_data(model)
    change(data)
    path = tmp_path / "MANO_RIGHT.pkl"
    path.write_bytes(pickle.dumps(data, 2))
    return path


def _set(key: str, place: Any, value: object) -> Callable[[dict[str, Any]], object]:
    def change(data: dict[str, Any]) -> None:
        data[key] = data[key].copy()
        data[key][place] = value

    return change


CAPPED = load_open_hand()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("hands_mean"), "the key hands_mean is missing; .* found J, J_regressor"),
        (
            lambda d: d.update(weights=d["weights"][:, :12]),
            r"weights has shape \(1609, 12\); expected \(1609, 16\)",
        ),
        (
            lambda d: d.update(posedirs=d["posedirs"][..., :9]),
            r"posedirs has shape .* expected \(1609, 3, 135\)",
        ),
        (lambda d: d.update(shapedirs=d["shapedirs"][..., :4]), "shapedirs has 4 shape coefficients; .* 10"),
        (lambda d: d.update(shapedirs=d["shapedirs"][0]), r"shapedirs has shape .* \(1609, 3, any\)"),
        (lambda d: d.update(hands_mean=d["hands_mean"][:6]), r"hands_mean has shape \(6,\)"),
        (lambda d: d.update(v_template=d["v_template"][:-3]), "has shape .*1609"),
        (lambda d: d.update(v_template="hand"), "v_template is a str"),
        (lambda d: d.update(v_template=d["v_template"].astype(str)), "v_template is a array of <U"),
        (
            lambda d: d.update(v_template=d["v_template"] * 1000.0),
            "middle knuckle 84.* from the wrist; .* metres",
        ),
        (lambda d: d.update(v_template=d["v_template"][:, [1, 2, 0]]), "the fingers do not lie along x"),
        (
            lambda d: d.update(v_template=d["v_template"] * [-1.0, 1.0, 1.0]),
            "model of a left hand .* right hand",
        ),
        (_set("v_template", (3, 1), np.nan), "v_template holds NaN"),
        (_set("weights", (3, 1), 9.0), "weights: some rows do not sum to 1"),
        (lambda d: d.update(f=d["f"].astype(float)), "f is an array of float64"),
        (lambda d: d.update(f=d["f"][:, ::-1]), "f: the faces look inward"),
        (_set("f", (0, 0), 1609), "f names the vertices 0 .. 1609; expected vertices 0 .. 1608"),
        (lambda d: d.update(f=d["f"][1:]), "f: the (mesh has several openings|faces do not form)"),
        (_set("f", 1, [1, 2, 3]), "f: the"),
        (_set("kintree_table", (0, 7), 1), "kintree_table has the parents"),
        (
            lambda d: d.update(kintree_table=np.zeros((2, 24), np.uint32)),
            "this is SMPL, a body model .*24 joints",
        ),
        (lambda d: d.update(kintree_table=np.zeros((2, 52), np.uint32)), r"this is SMPL\+H, a body model"),
        (lambda d: d.update(kintree_table=np.zeros((3, 16))), r"kintree_table has shape \(3, 16\)"),
        (lambda d: d.update(J_regressor=sparse.csc_matrix((10**6, 10**6))), "J_regressor has shape"),
        (lambda d: d.update(mano_data(CAPPED)), "f: the mesh is closed"),
        (lambda d: d.clear(), "the key kintree_table is missing"),
    ],
)
def test_wrong_files_end_as_one_line_that_names_the_key(
    change: Callable[[dict[str, Any]], object], message: str, tmp_path: Path, open_right: HandModel
) -> None:
    path = _edited(change, tmp_path, open_right)
    with pytest.raises(InputError, match=message) as error:
        load_mano(path, "right")
    assert str(error.value).startswith(f"{path}: ")
    assert "Use MANO_RIGHT.pkl of mano_v1_2" in str(error.value)
    assert "\n" not in str(error.value)


def test_exchanged_hands_are_noticed(folder: Path) -> None:
    with pytest.raises(InputError, match=r"a right hand .*expected a left hand.*Use MANO_LEFT\.pkl"):
        load_mano(folder / "MANO_RIGHT.pkl", "left")
    with pytest.raises(InputError, match=r"a left hand .*expected a right hand.*Use MANO_RIGHT\.pkl"):
        load_mano(folder / "MANO_LEFT.pkl", "right")


def test_pickles_of_other_things_are_refused(tmp_path: Path) -> None:
    (tmp_path / "MANO_RIGHT.pkl").write_bytes(python2_pickle((1, 2)))
    with pytest.raises(InputError, match="the file holds a tuple"):
        load_mano(tmp_path, "right")
    with pytest.raises(InputError, match="cannot be read"):
        load_mano(tmp_path / "none.pkl", "right")


def test_every_tip_is_on_the_last_bone_of_its_digit(hands: dict[str, HandModel]) -> None:
    for model in hands.values():
        bones = model.weights[model.tip_ids].argmax(axis=1)
        assert [MANO_JOINTS[bone] for bone in bones] == [f"{digit}3" for digit in DIGITS]


@pytest.mark.parity("smplx")
@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("flat_hand_mean", [True, False])
def test_equals_smplx(side: str, flat_hand_mean: bool, folder: Path, tmp_path: Path) -> None:
    """The file in the official layout, read here, and plain arrays of the same numbers, read by smplx."""
    import smplx
    import torch

    plain = write_mano(tmp_path, plain=True, left_bug=False)
    hand_of = {"use_pca": False, "flat_hand_mean": flat_hand_mean, "is_rhand": side == "right"}
    layer = smplx.MANO(str(plain["right" if side == "right" else "left"]), batch_size=4, **hand_of).double()
    model = load_mano(folder, "right" if side == "right" else "left")
    rng = np.random.default_rng(6)
    for _ in range(3):
        betas = rng.normal(size=10)
        pose = {
            "orientation_world": rng.normal(size=(4, 3)),
            "hand_pose": 0.4 * rng.normal(size=(4, 45)),
            "translation_world": rng.normal(size=(4, 3)),
        }
        ours = pose_hand(shape_hand(model, betas), **pose, flat_hand_mean=flat_hand_mean)
        with torch.no_grad():
            theirs = layer(
                betas=torch.tensor(betas)[None].repeat(4, 1),
                global_orient=torch.tensor(pose["orientation_world"]),
                hand_pose=torch.tensor(pose["hand_pose"]),
                transl=torch.tensor(pose["translation_world"]),
            )
        # smplx keeps single precision copies of the arrays; the parameters are doubles.
        np.testing.assert_allclose(ours.verts_world, theirs.vertices.numpy(), atol=1e-6)
        np.testing.assert_allclose(ours.joints_world[:, :16], theirs.joints.numpy()[:, :16], atol=1e-6)
