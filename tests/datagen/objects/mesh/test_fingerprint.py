"""Fingerprints: closed forms on simple shapes, equal for copies, apart for other shapes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from datagen.objects.formats.reading import read_object
from datagen.objects.mesh.decimation import decimated_mesh
from datagen.objects.mesh.fingerprint import Fingerprint
from datagen.objects.mesh.mesh_measures import measure_mesh
from datagen.objects.mesh.object_mesh import ObjectMesh
from datagen.objects.stores.library import REFERENCE_READING, StarterPack
from datagen.plan.same_objects import SAME_SHAPE, same_shapes


def print_of(mesh: ObjectMesh) -> Fingerprint:
    return measure_mesh(mesh).fingerprint


def distance(a: ObjectMesh, b: ObjectMesh) -> float:
    return float(np.abs(np.subtract(print_of(a).shape, print_of(b).shape)).max())


@pytest.fixture
def surface(plain_mesh):
    """ObjectMesh of a trimesh primitive."""
    return lambda made: plain_mesh(made.vertices, made.faces)


def test_a_sphere_and_a_cube_have_the_numbers_of_their_formulas(surface):
    ball = print_of(surface(trimesh.creation.icosphere(5, radius=0.05)))
    assert ball.size_m == pytest.approx(0.05, rel=1e-3)
    # On the unit sphere |x| = 1, the mean of x xᵀ is 1/3, the fourth moments are (dd + dd + dd) / 15, odd ones are 0.
    thirds = [3.0 ** (-1 / power) for power in (2, 4, 6) for _ in range(3)]
    expected = [*thirds, 1.0, 1.0, 0.0, 0.0, 5.0 ** (-1 / 8)]
    np.testing.assert_allclose(ball.shape, expected, atol=1e-3)
    cube = print_of(surface(trimesh.creation.box((0.2, 0.2, 0.2))))
    # Mean square distance of a face to the centre: s^2/4 + 2 s^2/12.
    assert cube.size_m == pytest.approx(0.2 * np.sqrt(1 / 4 + 1 / 6), rel=1e-9)
    assert cube.color == pytest.approx((0.735,) * 3, abs=0.01)  # sRGB of linear 0.5


@pytest.mark.parametrize("uid", ["starter/milk", "starter/rock_a", "starter/deer"])
def test_copies_in_another_unit_position_turn_mirror_order_and_resolution_are_equal(uid):
    mesh = StarterPack().load(uid).mesh
    rng = np.random.default_rng(0)
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))  # also mirrors, half of the time
    order = rng.permutation(len(mesh.faces))
    moved = replace(
        mesh,
        verts_obj=1000 * mesh.verts_obj @ turn.T + 3.0,
        faces=mesh.faces[order][:, [1, 2, 0]],
        corner_uv=mesh.corner_uv[order][:, [1, 2, 0]],
        face_material=mesh.face_material[order],
    )
    assert distance(mesh, moved) < 1e-9
    assert print_of(moved).size_m == pytest.approx(1000 * print_of(mesh).size_m)
    assert distance(mesh, decimated_mesh(mesh, int(0.9 * len(mesh.faces)))) < SAME_SHAPE


def test_a_finer_triangulation_of_the_same_surface_is_equal(surface):
    cylinder = trimesh.creation.cylinder(0.03, 0.1, sections=32)
    assert distance(surface(cylinder), surface(cylinder.subdivide().subdivide())) < 1e-9
    finer = trimesh.creation.cylinder(0.03, 0.1, sections=96)
    assert 1e-9 < distance(surface(cylinder), surface(finer)) < SAME_SHAPE


def test_other_proportions_are_other_shapes(surface):
    shapes = [
        *(
            trimesh.creation.box(sides)
            for sides in ((1, 1, 1), (1, 1, 1.1), (1, 1.1, 1.1), (1, 1, 2), (1, 2, 3))
        ),
        *(trimesh.creation.cylinder(0.5, height, sections=64) for height in (1.0, 1.1, 2.0)),
        trimesh.creation.icosphere(4, radius=0.5),
        trimesh.creation.capsule(1.0, 0.5),
    ]
    prints = np.array([print_of(surface(made)).shape for made in shapes])
    assert same_shapes(prints, prints) == [(k, k) for k in range(len(shapes))]


def test_no_two_objects_of_the_starter_pack_are_one():
    pack = StarterPack()
    prints = np.array([pack.measure(uid).fingerprint.shape for uid in pack.uids()])
    assert same_shapes(prints, prints) == [(k, k) for k in range(len(prints))]


YCB = Path(__file__).resolve().parents[5] / "shared" / "ycb"


@pytest.mark.skipif(not YCB.is_dir(), reason="the YCB objects are not here")
def test_scans_at_a_quarter_of_their_triangles_are_the_same_objects_and_no_others():
    """As YCB's google_64k and google_16k are."""
    meshes = [read_object(path, REFERENCE_READING).mesh for path in sorted(YCB.glob("*.glb"))]
    full = np.array([print_of(mesh).shape for mesh in meshes])
    quarter = np.array([print_of(decimated_mesh(mesh, len(mesh.faces) // 4)).shape for mesh in meshes])
    assert same_shapes(full, quarter) == [(k, k) for k in range(len(meshes))]
