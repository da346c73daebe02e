"""Originals are found in their copies; other objects and mirror images are not."""

from dataclasses import replace

import igl
import numpy as np
import pytest

from datagen.objects.errors import ObjectError
from datagen.objects.mesh.registration import REFERENCE_REGISTRATION, axis_rotations, register
from datagen.objects.stores.library import StarterPack
from tests.datagen.objects.official_files import graspxl_copy

QUICK = replace(REFERENCE_REGISTRATION, n_points=800)
# With and without texture, closed and open, with handles, sheets and inner walls, symmetric or not.
OBJECTS = (
    "baby_bottle", "biplane", "bread", "briefcase", "cactus", "coffee_brewer", "deer", "handbag",
    "headphones", "little_plant", "milk", "phone", "rock_a", "scissors", "speaker", "teddy_bear",
)  # fmt: skip
CHIRAL = ("rock_a", "rock_b", "rock_c", "cactus", "scissors")


@pytest.fixture(scope="module")
def pack():
    return StarterPack()


def registered(asset, copy, config=QUICK):
    return register(asset.mesh.verts_obj, asset.mesh.faces, copy.verts, copy.faces, config, source=asset.uid)


def moved(points, T):
    return points @ T[:3, :3].T + T[:3, 3]


def test_there_are_24_rotations():
    turns = axis_rotations()
    assert len({turn.tobytes() for turn in (np.round(t) + 0.0 for t in turns)}) == 24
    assert all(np.linalg.det(turn) == pytest.approx(1) for turn in turns)
    np.testing.assert_array_equal(turns[0], np.eye(3))
    np.testing.assert_array_equal(turns[1] @ [0, 0, 1], [0, 1, 0])  # Z-up back to Y-up


@pytest.mark.parametrize("name", OBJECTS)
def test_original_is_found_in_its_copy(pack, name):
    """Up to symmetry: where the vertices come to lie, against the surface where they belong."""
    asset = pack.load(f"starter/{name}")
    turn = axis_rotations()[OBJECTS.index(name) * 5 % 24]
    copy = graspxl_copy(asset, turn=turn)
    found = registered(asset, copy)
    diagonal = np.linalg.norm(np.ptp(copy.verts, axis=0))
    truth = np.ascontiguousarray(moved(asset.mesh.verts_obj, copy.T_copy_from_object))
    here = np.ascontiguousarray(moved(asset.mesh.verts_obj, found.T_rescaled_from_original))
    squared, _, _ = igl.point_mesh_squared_distance(here, truth, asset.mesh.faces)
    assert np.sqrt(np.percentile(squared, 95)) < 0.01 * diagonal
    assert found.residual < 0.01
    assert found.scale == pytest.approx(np.cbrt(np.linalg.det(copy.T_copy_from_object[:3, :3])), rel=0.02)


def test_known_turn_of_an_asymmetric_object_is_found_exactly(pack):
    asset = pack.load("starter/rock_a")
    for turn in axis_rotations()[::5]:
        found = registered(asset, graspxl_copy(asset, turn=turn))
        np.testing.assert_array_equal(found.axis_rotation, turn)
        assert found.residual < 1e-6


def test_symmetric_objects_get_the_expected_turn(pack):
    """A box fits in four turns: none of them is taken where it is among them."""
    box = np.array([[x, y, z] for x in (-3.0, 3.0) for y in (-2.0, 2.0) for z in (-1.0, 1.0)])
    faces = np.array(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
         [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    )  # fmt: skip
    found = register(box, faces, 0.01 * box, faces, QUICK, source="box")
    np.testing.assert_array_equal(found.axis_rotation, np.eye(3))
    assert found.scale == pytest.approx(0.01, rel=1e-4)
    y_up = axis_rotations()[1]
    found = register(box, faces, 0.01 * box @ y_up.T, faces, QUICK, source="box")
    np.testing.assert_array_equal(found.axis_rotation, y_up)


def test_inner_walls_of_the_original_do_not_count(pack):
    """The original has a small copy of itself inside, which its own copy has lost."""
    asset = pack.load("starter/rock_a")
    copy = graspxl_copy(asset)
    verts, faces = asset.mesh.verts_obj, asset.mesh.faces
    found = register(
        np.concatenate([verts, 0.4 * verts]),
        np.concatenate([faces, faces + len(verts)]),
        copy.verts,
        copy.faces,
        QUICK,
        source="rock",
    )
    assert found.original_to_rescaled_p95_m < 1e-3 * np.linalg.norm(np.ptp(copy.verts, axis=0))


@pytest.mark.parametrize(("name", "other"), [("text_marker", "flacon"), ("milk", "bread")])
def test_another_object_is_refused(pack, name, other):
    with pytest.raises(ObjectError, match=r"does not match its rescaled copy|has other proportions"):
        registered(pack.load(f"starter/{name}"), graspxl_copy(pack.load(f"starter/{other}")))


@pytest.mark.parametrize("name", CHIRAL)
def test_mirror_image_is_refused_unless_symmetric(pack, name):
    asset = pack.load(f"starter/{name}")
    copy = graspxl_copy(asset)
    mirrored = replace(copy, verts=copy.verts * [-1, 1, 1], faces=copy.faces[:, ::-1])
    with pytest.raises(ObjectError, match="does not match its rescaled copy"):
        registered(asset, mirrored)


def test_anisotropic_copy_is_refused(pack):
    asset = pack.load("starter/rock_a")
    copy = graspxl_copy(asset)
    stretched = replace(copy, verts=copy.verts * [1.15, 1, 1])
    with pytest.raises(ObjectError, match="has other proportions"):
        registered(asset, stretched)
