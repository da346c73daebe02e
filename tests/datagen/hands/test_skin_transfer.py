"""The open hand's skin on other meshes of the same hand: every colour where it belongs."""

import time
from dataclasses import replace

import fast_simplification
import numpy as np
import pytest
import trimesh
from jaxtyping import Float

from datagen.hands.model import HandModel, load_open_hand, mirror_hand, pose_hand, shape_hand
from datagen.hands.skin import decode_skin, load_open_skin, open_nail_mask_png
from datagen.hands.skin_transfer import transferred_corner_uv
from shards.joints import DIGITS
from shards.storage.png import decode_png
from tests.datagen.hands.official_files import texture_lookup, uncapped

BETAS = {"same": np.zeros(10), "other": np.array([1.0, -0.8, 0.9, -1.1, 0.7, 0.5, -0.6, 1.0, -0.4, 0.3])}
MESHES = {"decimated": 1500, "coarse": 900, "subdivided": None}


@pytest.fixture(scope="module")
def texture() -> Float[np.ndarray, "row column 3"]:
    skin = load_open_skin()
    return decode_skin(skin, skin.anchors[0]).astype(np.float64)


@pytest.fixture(scope="module")
def nails() -> Float[np.ndarray, "row column 3"]:
    return np.repeat(decode_png(open_nail_mask_png())[..., None] / 255.0, 3, axis=-1)


def _retriangulated(n_faces: int | None) -> HandModel:
    """The open hand without its cap on other triangles: decimated, or each cut in four."""
    model = uncapped(load_open_hand())
    if n_faces is None:
        verts, faces = trimesh.remesh.subdivide(model.v_template, model.faces)
    else:
        verts, faces = fast_simplification.simplify(
            model.v_template.astype(np.float32), model.faces.astype(np.int32), target_count=n_faces
        )
    triangle, barycentric = _places(model, np.asarray(verts, dtype=np.float64))

    def carried(values: Float[np.ndarray, "vert ..."]) -> Float[np.ndarray, "new ..."]:
        return np.einsum("nk,nk...->n...", barycentric, values[model.faces[triangle]])

    verts = carried(model.v_template)
    tips = np.linalg.norm(verts - model.v_template[model.tip_ids][:, None], axis=-1).argmin(axis=1)
    joints = model.J_regressor @ model.v_template
    homogeneous = np.concatenate([verts, np.ones((len(verts), 1))], axis=1)
    return replace(
        model,
        v_template=verts,
        shapedirs=carried(model.shapedirs),
        posedirs=np.zeros((len(verts), 3, 135)),
        J_regressor=np.concatenate([joints, np.ones((16, 1))], axis=1) @ np.linalg.pinv(homogeneous),
        weights=carried(model.weights),
        faces=np.asarray(faces, dtype=np.int64),
        tip_ids=tips,
        corner_uv=np.zeros((len(faces), 3, 2)),
    )


def _places(model: HandModel, points: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Face and barycentric coordinates of the closest points on the hand."""
    mesh = trimesh.Trimesh(model.v_template, model.faces, process=False)
    closest, _, triangle = trimesh.proximity.closest_point(mesh, points)
    return triangle, trimesh.triangles.points_to_barycentric(mesh.triangles[triangle], closest)


@pytest.fixture(scope="module", params=[(m, b) for m in MESHES for b in BETAS], ids="-".join)
def case(request: pytest.FixtureRequest) -> dict[str, np.ndarray]:
    """Points all over a target: their transferred UV, and the UV of the same point of the source."""
    mesh, betas = request.param
    source = load_open_hand()
    flat = _retriangulated(MESHES[mesh])
    joints = source.J_regressor @ shape_hand(source, BETAS[betas]).verts_rest
    verts = shape_hand(flat, BETAS[betas]).verts_rest
    homogeneous = np.concatenate([verts, np.ones((len(verts), 1))], axis=1)
    regressor = np.concatenate([joints, np.ones((16, 1))], axis=1) @ np.linalg.pinv(homogeneous)
    target = replace(flat, v_template=verts, J_regressor=regressor)
    started = time.process_time()
    corner_uv = transferred_corner_uv(source, target)
    seconds = time.process_time() - started
    share = np.random.default_rng(0).dirichlet(np.ones(3), 4 if mesh == "subdivided" else 12)
    points = np.einsum("sk,fkd->fsd", share, flat.v_template[flat.faces]).reshape(-1, 3)
    open_hand = uncapped(source)
    triangle, barycentric = _places(open_hand, points)
    area = trimesh.triangles.area(verts[flat.faces])
    return {
        "uv": np.einsum("sk,fkd->fsd", share, corner_uv).reshape(-1, 2),
        "expected": np.einsum("nk,nkd->nd", barycentric, open_hand.corner_uv[triangle]),
        "weight": np.repeat(area, len(share)) / (area.sum() * len(share)),
        "corner_uv": corner_uv,
        "seconds": np.array(seconds),
        "points": points,
        "coarse": np.array(mesh == "coarse"),
    }


def test_colours_are_those_of_the_same_point_of_the_source(
    case: dict[str, np.ndarray], texture: np.ndarray
) -> None:
    error = np.abs(texture_lookup(texture, case["uv"]) - texture_lookup(texture, case["expected"]))
    mean = float(case["weight"] @ error.mean(axis=1))
    off = float(case["weight"] @ (error.max(axis=1) > 30.0))
    print(
        f"mean error {mean:.2f} of 255, beyond 30 on {100 * off:.2f} % of the hand, {case['seconds']:.2f} s"
    )
    assert mean < (3.0 if case["coarse"] else 2.0)
    assert off < 0.01


def test_no_point_reads_beyond_the_painted_islands(case: dict[str, np.ndarray], texture: np.ndarray) -> None:
    assert texture_lookup(texture, case["uv"]).min(axis=0).max() > 20.0
    assert (texture_lookup(texture, case["uv"]).sum(axis=1) > 30.0).all()


def test_no_triangle_spans_a_seam(case: dict[str, np.ndarray]) -> None:
    """Seams are far apart in the layout, a triangle on both sides would be as large."""
    own = np.ptp(load_open_hand().corner_uv, axis=1).max()
    assert np.ptp(case["corner_uv"], axis=1).max() < (3.0 if case["coarse"] else 1.7) * own


def test_nails_land_on_nails(case: dict[str, np.ndarray], nails: np.ndarray) -> None:
    there, expected = (texture_lookup(nails, case[key])[:, 0] > 0.5 for key in ("uv", "expected"))
    both = float(case["weight"] @ (there & expected))
    either = float(case["weight"] @ (there | expected))
    assert both / either > 0.75
    hand = load_open_hand()
    tip = np.linalg.norm(case["points"][there & expected][:, None] - hand.v_template[hand.tip_ids], axis=-1)
    assert set(tip.argmin(axis=1)) == set(range(len(DIGITS)))


def test_a_mesh_as_fine_as_mano_takes_less_than_a_second(case: dict[str, np.ndarray]) -> None:
    """1,538 faces in MANO; the subdivided mesh has eight times as many."""
    assert case["seconds"] < (1.0 if len(case["corner_uv"]) < 2000 else 4.0)


def test_the_same_mesh_gets_its_own_layout_back() -> None:
    for side in ("right", "left"):
        source = load_open_hand(side)
        target = uncapped(source)
        np.testing.assert_allclose(transferred_corner_uv(source, target), target.corner_uv, atol=1e-6)


def test_left_hands_are_mirror_images() -> None:
    right = _retriangulated(1500)
    left_uv = transferred_corner_uv(load_open_hand("left"), mirror_hand(right))
    right_uv = transferred_corner_uv(load_open_hand(), right)
    difference = np.abs(left_uv[:, ::-1] - right_uv).max(axis=(1, 2))
    assert np.mean(difference < 1e-6) > 0.99  # ties between equally close points may fall either way


def test_hands_of_two_sides_are_refused() -> None:
    with pytest.raises(ValueError, match="skin of a right hand on a left hand"):
        transferred_corner_uv(load_open_hand(), load_open_hand("left"))


def test_turned_and_thicker_digits_still_find_their_nails(nails: np.ndarray) -> None:
    """Another rest pose, as other models have: thumb and fingers turned by several degrees."""
    source = load_open_hand()
    flat = uncapped(source)
    pose = np.random.default_rng(2).normal(scale=0.1, size=(1, 45))
    zero = np.zeros((1, 3))
    shaped = shape_hand(flat, BETAS["other"])
    posed = pose_hand(
        shaped, orientation_world=zero, hand_pose=pose, translation_world=zero, flat_hand_mean=True
    )
    verts, joints = posed.verts_world[0], posed.joints_world[0, :16]
    homogeneous = np.concatenate([verts, np.ones((len(verts), 1))], axis=1)
    regressor = np.concatenate([joints, np.ones((16, 1))], axis=1) @ np.linalg.pinv(homogeneous)
    uv = transferred_corner_uv(source, replace(flat, v_template=verts, J_regressor=regressor))
    there, expected = (texture_lookup(nails, c.mean(axis=1))[:, 0] > 0.5 for c in (uv, flat.corner_uv))
    assert (there & expected).sum() / (there | expected).sum() > 0.75
