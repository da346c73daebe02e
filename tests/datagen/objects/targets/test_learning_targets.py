"""Learning targets against shapes that are known exactly."""

import numpy as np
import pytest
import trimesh

from datagen.objects.asset.object_asset import ObjectAsset, WatertightMesh
from datagen.objects.mesh.texture_quality import TextureQuality
from datagen.objects.targets.learning_targets import LearningTargets, TargetsConfig, learning_targets
from datagen.objects.targets.occupancy import surface_voxels
from datagen.objects.watertight.watertight_mesh import signed_distance, watertight_surface

CONFIG = TargetsConfig(
    surface_points=2048, sdf_near_points=1024, sdf_near_sigma=0.02, sdf_uniform_points=1024
)


def make_asset(mesh, surface) -> ObjectAsset:
    return ObjectAsset(
        uid="test/shape",
        name="shape",
        source="made here",
        licence="CC0-1.0",
        author="nobody",
        url="",
        mesh=mesh,
        watertight=WatertightMesh(
            verts_obj=surface.verts_obj,
            faces=surface.faces,
            parts=(),
            watertight_source=surface.watertight_source,
        ),
        catalogue_scale=1.0,
        texture=TextureQuality(texture_resolution_px=0, color_detail=0.0),
    )


@pytest.fixture
def box_targets(box, plain_mesh, watertight_config) -> LearningTargets:
    asset = make_asset(plain_mesh(*box), watertight_surface(*box, watertight_config, source="box"))
    return learning_targets(asset, 7, CONFIG)


HALF = np.array([0.5, 0.4, 0.3])  # of the box, canonical


def box_distance(points: np.ndarray) -> np.ndarray:
    beyond = np.abs(points) - HALF
    return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)


def test_signed_distance_is_that_of_the_box(box_targets):
    expected = box_distance(box_targets.sdf_points.astype(np.float64))
    np.testing.assert_allclose(box_targets.sdf_values, expected, atol=2e-7)
    assert (box_targets.sdf_values < 0).any()
    assert (box_targets.sdf_values > 0).any()


def test_occupancy_is_the_surface_and_not_the_inside(box_targets):
    """A voxel is set exactly when the box's surface passes through it."""
    index = np.stack(np.meshgrid(*[np.arange(64)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    low, high = index / 64 - 0.5, (index + 1) / 64 - 0.5
    clipped = np.minimum(HALF, 0.5 - 1e-6)
    touches_watertight = ((low <= clipped) & (high >= -clipped)).all(axis=1)
    strictly_inside = ((low > -clipped) & (high < clipped)).all(axis=1)
    np.testing.assert_array_equal(box_targets.occupancy_64, index[touches_watertight & ~strictly_inside])


def test_occupancy_holds_every_voxel_a_sphere_passes():
    sphere = trimesh.creation.icosphere(4, 0.4)
    voxels = {tuple(v) for v in surface_voxels(np.array(sphere.vertices), np.array(sphere.faces), 64)}
    points, _ = trimesh.sample.sample_surface(sphere, 100_000, seed=1)
    passed = {tuple(v) for v in np.floor((points + 0.5) * 64).astype(int)}
    assert passed <= voxels
    centers = (np.array(sorted(voxels)) + 0.5) / 64 - 0.5
    assert np.abs(np.linalg.norm(centers, axis=1) - 0.4).max() <= 0.5 * np.sqrt(3) / 64 + 2e-3


def test_surface_points_lie_on_the_box_with_its_normals(box_targets):
    points = box_targets.surface_points.astype(np.float64)
    np.testing.assert_allclose(box_distance(points), 0, atol=1e-7)
    stepped = points + 1e-3 * box_targets.surface_normals
    np.testing.assert_allclose(box_distance(stepped), 1e-3, atol=1e-6)
    assert len(np.unique(box_targets.surface_normals.round(6), axis=0)) == 6


def test_colour_is_the_material_as_srgb(box_targets):
    assert (box_targets.surface_colors == 188).all()  # linear 0.5


def test_metres_come_back(box_targets, box):
    assert box_targets.object_scale_m == pytest.approx(0.10)
    T = box_targets.T_objmesh_from_canonical
    points_m = box_targets.surface_points @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(np.abs(points_m).max(axis=0), [0.05, 0.04, 0.03], atol=1e-6)


def test_same_seed_same_bytes_and_other_seed_other_points(box, plain_mesh, watertight_config, box_targets):
    asset = make_asset(plain_mesh(*box), watertight_surface(*box, watertight_config, source="box"))
    again = learning_targets(asset, 7, CONFIG)
    other = learning_targets(asset, 8, CONFIG)
    for name in ("occupancy_64", "surface_points", "surface_colors", "sdf_points", "sdf_values"):
        np.testing.assert_array_equal(getattr(again, name), getattr(box_targets, name))
    assert not np.array_equal(other.sdf_points, box_targets.sdf_points)


@pytest.mark.parametrize("shape", ["open_box", "sheet_cup", "crossing_boxes"])
def test_distance_field_of_awkward_meshes(shape, request, plain_mesh, watertight_config):
    """Gradient norm 1 almost everywhere, sign as an eye would say, values as far as the surface."""
    verts, faces = request.getfixturevalue(shape)
    surface = watertight_surface(verts, faces, watertight_config, source=shape)
    targets = learning_targets(make_asset(plain_mesh(verts, faces), surface), 0, CONFIG)
    points = targets.sdf_points.astype(np.float64)
    canonical = surface.verts_obj / targets.object_scale_m
    step = 1e-4
    gradient = np.stack(
        [
            signed_distance(canonical, surface.faces, points + step * axis)
            - signed_distance(canonical, surface.faces, points - step * axis)
            for axis in np.eye(3)
        ],
        axis=1,
    ) / (2 * step)
    norm = np.linalg.norm(gradient, axis=1)
    assert np.mean(np.abs(norm - 1) < 1e-2) > 0.95  # elsewhere: the medial axis
    if shape != "crossing_boxes":  # sheets: only a thin skin is inside
        uniform = targets.sdf_values[CONFIG.sdf_near_points :]
        assert (uniform < 0).mean() < 0.06
    assert np.abs(targets.surface_points).max() < 0.52


def test_crossing_boxes_have_the_sign_of_their_union(crossing_boxes, plain_mesh, watertight_config):
    surface = watertight_surface(*crossing_boxes, watertight_config, source="boxes")
    asset = make_asset(plain_mesh(*crossing_boxes), surface)
    targets = learning_targets(asset, 0, CONFIG)
    points_m = np.abs(targets.sdf_points * targets.object_scale_m)
    inside = (points_m < [0.05, 0.04, 0.03]).all(axis=1) | (points_m < [0.015, 0.015, 0.075]).all(axis=1)
    clear = np.abs(targets.sdf_values) > 1e-5
    np.testing.assert_array_equal(targets.sdf_values[clear] < 0, inside[clear])
