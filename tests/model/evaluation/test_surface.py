"""Scores of meshes against closed forms."""

import numpy as np
import pytest
import trimesh

from model.data.batch import SurfaceTarget
from model.evaluation.surface import point_score, sample_mesh, surface_score
from model.surface.mesh import SurfaceMesh


def sphere(radius: float, color: float = 0.5) -> SurfaceMesh:
    shape = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return SurfaceMesh(
        vertices=np.asarray(shape.vertices, np.float32),
        faces=np.asarray(shape.faces, np.int32),
        colors=np.full((len(shape.vertices), 3), color, np.float32),
    )


def true_sphere(radius: float, scale_m: float) -> SurfaceTarget:
    normals = np.random.default_rng(1).standard_normal((8000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return SurfaceTarget(
        points=(radius * normals).astype(np.float32),
        normals=normals.astype(np.float32),
        colors=np.full((8000, 3), 128, np.uint8),
        sdf_points=np.zeros((1, 3), np.float32),
        sdf_values=np.zeros(1, np.float32),
        object_scale_m=scale_m,
    )


def test_points_moved_apart_score_their_distance():
    grid = np.stack(np.meshgrid(*[np.arange(5) * 0.1] * 3), -1).reshape(-1, 3)
    score = point_score(grid + np.array([0.007, 0.0, 0.0]), grid)
    assert score.chamfer_cm == pytest.approx(1.4)  # the sum of both directions
    assert (score.f_5mm, score.f_10mm) == (0.0, 100.0)


def test_the_threshold_itself_counts():
    score = point_score(np.array([[0.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.005]]))
    assert score.f_5mm == 100.0


def test_f_score_balances_precision_and_recall():
    """Half of the found points are right, all true points are found: P = 1/2, R = 1, F = 2/3."""
    true = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    found = np.concatenate([true, true + np.array([0.0, 0.5, 0.0])])
    assert point_score(found, true).f_5mm == pytest.approx(200 / 3)


def test_nothing_found_is_infinitely_far():
    score = point_score(np.zeros((0, 3)), np.zeros((4, 3)))
    assert score.chamfer_cm == float("inf")
    assert score.f_10mm == 0.0


def test_a_larger_sphere_is_off_by_the_difference_in_metres():
    truth = true_sphere(0.4, scale_m=0.2)
    exact = surface_score(sphere(0.4), truth, 30_000, np.random.default_rng(0))
    larger = surface_score(sphere(0.45), truth, 30_000, np.random.default_rng(0))
    assert exact.points.f_5mm > 99.9
    assert exact.normal_deg < 3
    assert exact.color < 0.01
    assert larger.points.f_5mm == 0.0  # 0.05 * 0.2 m = 1 cm away
    assert larger.points.chamfer_cm == pytest.approx(2.0, abs=0.15)
    assert larger.normal_deg < 3


def test_an_inside_out_mesh_has_its_normals_reversed():
    mesh = sphere(0.4, color=0.75)
    turned = SurfaceMesh(vertices=mesh.vertices, faces=mesh.faces[:, ::-1].copy(), colors=mesh.colors)
    score = surface_score(turned, true_sphere(0.4, 0.2), 30_000, np.random.default_rng(0))
    assert score.normal_deg > 177
    assert score.color == pytest.approx(0.25, abs=0.01)


def test_points_on_a_mesh_are_even_over_its_area():
    """A small and a large square: points as their areas, inside them."""
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    mesh = SurfaceMesh(
        vertices=np.concatenate([square, 3 * square + [5, 0, 0]]).astype(np.float32),
        faces=np.concatenate([faces, faces + 4]),
        colors=np.zeros((8, 3), np.float32),
    )
    points = sample_mesh(mesh, 20_000, np.random.default_rng(0)).points
    small = points[:, 0] <= 1
    assert small.mean() == pytest.approx(0.1, abs=0.01)
    assert np.histogram2d(points[~small, 0], points[~small, 1], bins=3)[0].min() > 0.9 * (~small).sum() / 9
