"""Closed surfaces of closed, open, torn, inside-out and self-intersecting meshes."""

import igl
import numpy as np
import pytest
import trimesh

from datagen.objects.errors import ObjectError
from datagen.objects.watertight.watertight_mesh import (
    decimated_watertight,
    signed_distance,
    watertight_surface,
)


def as_trimesh(surface) -> trimesh.Trimesh:
    return trimesh.Trimesh(surface.verts_obj, surface.faces, process=False)


def inside(surface, points) -> np.ndarray:
    return signed_distance(surface.verts_obj, surface.faces, np.asarray(points, dtype=np.float64)) < 0


def test_closed_mesh_keeps_its_own_surface(box, watertight_config):
    surface = watertight_surface(*box, watertight_config, source="box")
    assert surface.watertight_source
    assert len(surface.faces) == 12
    assert as_trimesh(surface).volume == pytest.approx(480e-6)


def test_inside_out_mesh_is_turned(box, watertight_config):
    surface = watertight_surface(box[0], box[1][:, ::-1], watertight_config, source="box")
    assert as_trimesh(surface).volume == pytest.approx(480e-6)


def test_crossing_boxes_become_their_union(crossing_boxes, watertight_config):
    surface = watertight_surface(*crossing_boxes, watertight_config, source="boxes")
    assert as_trimesh(surface).is_watertight
    assert as_trimesh(surface).volume == pytest.approx(561e-6)
    assert inside(surface, [[0, 0, 0], [0, 0, 0.06]]).all()


def test_box_without_lid_stays_open_and_gets_walls(open_box, watertight_config):
    surface = watertight_surface(*open_box, watertight_config, source="open box")
    mesh = as_trimesh(surface)
    assert not surface.watertight_source
    assert mesh.is_watertight
    assert not inside(surface, [[0, 0, 0], [0, 0, 0.029], [0.045, 0.035, 0.02], [0, 0, -0.02]]).any()
    walls = [[0.05, 0, 0], [-0.05, 0, 0], [0, 0.04, 0], [0, -0.04, 0.02], [0, 0, -0.03]]
    assert inside(surface, walls).all()
    sheet_m, area = 1.8e-3, 0.10 * 0.08 + 2 * 0.06 * (0.10 + 0.08)
    assert mesh.volume == pytest.approx(area * sheet_m, rel=0.15)


def test_paper_cup_is_not_filled(sheet_cup, watertight_config):
    surface = watertight_surface(*sheet_cup, watertight_config, source="cup")
    mesh = as_trimesh(surface)
    assert mesh.is_watertight
    axis = np.column_stack([np.zeros(9), np.zeros(9), np.linspace(-0.045, 0.05, 9)])
    assert not inside(surface, axis).any()
    assert mesh.volume < 0.15 * np.pi * 0.035**2 * 0.10  # a full cup would be 1
    squared, _, _ = igl.point_mesh_squared_distance(surface.verts_obj, *sheet_cup)
    assert np.sqrt(squared).max() < 1.5e-3  # half a sheet, and a little at the rim's corner


def test_torn_sphere_is_mended(watertight_config):
    sphere = trimesh.creation.icosphere(4, 0.05)
    torn = np.delete(sphere.faces, [5, 300], axis=0)
    surface = watertight_surface(np.array(sphere.vertices), torn, watertight_config, source="torn")
    assert as_trimesh(surface).is_watertight
    assert inside(surface, [[0, 0, 0], [0.03, 0.03, 0]]).all()
    assert as_trimesh(surface).volume == pytest.approx(4 / 3 * np.pi * 0.05**3, rel=0.02)


def test_inner_faces_do_not_make_cavities(box, watertight_config):
    """A box with a sheet across its inside, as kit-bashed models have."""
    verts = np.concatenate([box[0], [[-0.05, -0.04, 0], [0.05, -0.04, 0], [0.05, 0.04, 0], [-0.05, 0.04, 0]]])
    faces = np.concatenate([box[1], [[8, 9, 10], [8, 10, 11]]])
    surface = watertight_surface(verts, faces, watertight_config, source="box with sheet")
    assert as_trimesh(surface).is_watertight
    assert as_trimesh(surface).body_count == 1
    assert as_trimesh(surface).volume == pytest.approx(480e-6, rel=0.03)


def test_hollow_shell_is_filled(watertight_config):
    """Nothing reaches the inner cavity, so nobody can tell it from a full ball."""
    outer, inner = trimesh.creation.icosphere(4, 0.05), trimesh.creation.icosphere(3, 0.03)
    verts = np.concatenate([outer.vertices, inner.vertices])
    faces = np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.vertices)])
    surface = watertight_surface(verts, faces, watertight_config, source="shell")
    assert surface.watertight_source
    assert inside(surface, [[0, 0, 0]]).all()


def test_signed_distance_of_a_box_is_exact(box):
    rng = np.random.default_rng(0)
    verts, faces = box
    points = rng.uniform(-0.09, 0.09, (2000, 3))
    outside = np.maximum(np.abs(points) - [0.05, 0.04, 0.03], 0.0)
    within = np.minimum((np.abs(points) - [0.05, 0.04, 0.03]).max(axis=1), 0.0)
    expected = np.linalg.norm(outside, axis=1) + within
    np.testing.assert_allclose(signed_distance(verts, faces, points), expected, atol=1e-12)


def test_decimation_keeps_a_ball_closed():
    ball = trimesh.creation.icosphere(5, 0.05)
    verts, faces = decimated_watertight(np.array(ball.vertices), np.array(ball.faces), 1500)
    light = trimesh.Trimesh(verts, faces, process=False)
    assert len(faces) <= 1500
    assert light.is_watertight
    assert light.volume == pytest.approx(ball.volume, rel=0.01)


def test_nothing_watertight_is_refused(watertight_config):
    """Specks below eight voxels are not an object."""
    verts = np.array([[0, 0, 0], [1e-6, 0, 0], [0, 1e-6, 0], [0.1, 0, 0]], dtype=np.float64)
    with pytest.raises(ObjectError, match="encloses no volume"):
        watertight_surface(verts, np.array([[0, 1, 2]]), watertight_config, source="speck")


def test_same_mesh_same_surface(open_box, watertight_config):
    first = watertight_surface(*open_box, watertight_config, source="a")
    second = watertight_surface(*open_box, watertight_config, source="a")
    np.testing.assert_array_equal(first.verts_obj, second.verts_obj)
    np.testing.assert_array_equal(first.faces, second.faces)
