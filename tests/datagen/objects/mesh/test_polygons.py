"""Polygons to triangles: areas, windings, order."""

import numpy as np
import pytest

from datagen.objects.mesh.polygons import triangulated

SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
ARROW = [[0, 0, 0], [2, -1, 0], [0, 2, 0], [-2, -1, 0]]  # a concave quad: its first corner turns back
L_SHAPE = [[0, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0], [1, 2, 0], [0, 2, 0]]


def area_vectors(verts, triangles):
    a, b, c = (verts[triangles[:, k]] for k in range(3))
    return 0.5 * np.cross(b - a, c - a)


def shoelace(points):
    following = np.roll(points, -1, axis=0)
    return 0.5 * (points[:, 0] * following[:, 1] - points[:, 1] * following[:, 0]).sum()


@pytest.mark.parametrize("shape", [SQUARE, ARROW, L_SHAPE])
@pytest.mark.parametrize("first", range(4))
@pytest.mark.parametrize("flipped", [False, True])
def test_area_and_winding_are_kept(shape, first, flipped):
    flat = np.roll(np.array(shape, dtype=float), first, axis=0)[:: -1 if flipped else 1]
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    verts = flat @ turn.T
    corners, polygon = triangulated(verts, np.arange(len(verts)), np.array([len(verts)]))
    assert len(corners) == len(verts) - 2
    assert not polygon.any()
    areas = area_vectors(verts, corners) @ turn[:, 2]
    assert areas.sum() == pytest.approx(shoelace(flat))
    assert (areas * np.sign(shoelace(flat)) > 0).all()  # none lies outside or is turned over


def test_polygons_of_all_lengths_keep_their_order():
    verts = np.array([*SQUARE, *L_SHAPE], dtype=float)
    corners = np.array([0, 1, 2, 3, 0, 1, 4, 5, 6, 7, 8, 9, 1, 2, 3])
    triangles, polygon = triangulated(verts, corners, np.array([4, 2, 6, 0, 3]))
    np.testing.assert_array_equal(polygon, [0, 0, 2, 2, 2, 2, 4])  # a line and nothing draw nothing
    np.testing.assert_array_equal(triangles[-1], [12, 13, 14])
    areas = area_vectors(verts, corners[triangles])[:, 2]
    np.testing.assert_allclose(np.bincount(polygon, areas), [1, 0, 3, 0, 0.5])


def test_polygons_without_a_plane_are_fans():
    for verts in (np.full((4, 3), np.nan), np.zeros((5, 3)), np.eye(3)[[0, 0, 0, 0]]):
        corners, _ = triangulated(verts, np.arange(len(verts)), np.array([len(verts)]))
        np.testing.assert_array_equal(corners[:, 0], 0)
        assert len(corners) == len(verts) - 2
