"""Images against the formula of a sphere, against ray casting, and against themselves turned."""

import numpy as np
import pytest
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector

from model.errors import ModelError
from model.surface.mesh import SurfaceMesh
from model.surface.rasteriser import Shading, rasterise, render_mesh
from model.surface.turntable import TurntableConfig, turntable
from shards.geometry import intrinsics_from_fov, invert_transform, look_at, pixel_rays_cam

SIZE = (160, 120)
K = intrinsics_from_fov(0.7, SIZE)
T_CAM_FROM_OBJ = look_at(np.array([0.6, -1.5, 0.8]), np.zeros(3), roll_rad=0.3)
WHITE = (1.0, 1.0, 1.0)
PLAIN = Shading(two_sided=True, ambient=1.0, background_rgb=WHITE)


def _mesh(shape: trimesh.Trimesh, seed: int = 0) -> SurfaceMesh:
    colors = np.random.default_rng(seed).random((len(shape.vertices), 3))
    return SurfaceMesh(
        vertices=shape.vertices.astype(np.float32),
        faces=shape.faces.astype(np.int32),
        colors=colors.astype(np.float32),
    )


def test_depth_of_a_sphere_follows_the_formula() -> None:
    mesh = _mesh(trimesh.creation.icosphere(6, radius=0.4))
    depth = render_mesh(mesh, K, T_CAM_FROM_OBJ, SIZE, PLAIN).depth
    rays = pixel_rays_cam(K, SIZE)
    center = T_CAM_FROM_OBJ[:3, 3]
    a, b = (rays**2).sum(-1), rays @ center
    discriminant = b**2 - a * (center @ center - 0.4**2)
    truth = np.where(discriminant > 0, (b - np.sqrt(np.maximum(discriminant, 0))) / a, 0.0)
    sure = np.abs(discriminant) > 0.005
    assert np.array_equal(depth[sure] > 0, truth[sure] > 0)
    assert np.abs(depth - truth)[sure].max() < 1e-3


def test_ray_casting_sees_the_same_faces() -> None:
    rng = np.random.default_rng(0)
    parts = []
    for _ in range(40):
        box = trimesh.creation.box(
            rng.uniform(0.02, 0.4, 3), trimesh.transformations.random_rotation_matrix(rng.random(3))
        )
        parts.append(box.apply_translation(rng.uniform(-0.3, 0.3, 3)))
    shape = trimesh.util.concatenate(parts)
    assert isinstance(shape, trimesh.Trimesh)
    image = render_mesh(_mesh(shape), K, T_CAM_FROM_OBJ, SIZE, PLAIN)
    T_obj_from_cam = invert_transform(T_CAM_FROM_OBJ)
    rays = (pixel_rays_cam(K, SIZE) @ T_obj_from_cam[:3, :3].T).reshape(-1, 3)
    origins = np.broadcast_to(T_obj_from_cam[:3, 3], rays.shape)
    points, ray, face = RayMeshIntersector(shape).intersects_location(origins, rays, multiple_hits=False)
    cast = np.full(len(rays), -1)
    cast[ray] = face
    depth = np.zeros(len(rays))
    depth[ray] = (points @ T_CAM_FROM_OBJ[:3, :3].T + T_CAM_FROM_OBJ[:3, 3])[:, 2]
    assert image.mask.sum() > 5000
    assert (image.face.reshape(-1) == cast).mean() > 0.999  # the rest on edges
    assert (np.abs(image.depth.reshape(-1) - depth) < 1e-4).mean() > 0.999


def test_colours_are_interpolated_in_space_and_not_in_the_image() -> None:
    """A slanted triangle: at every pixel the barycentric coordinates of the point on the triangle."""
    points_cam = np.array([[-0.5, -0.4, 1.0], [0.6, -0.3, 4.0], [0.0, 0.8, 2.0]])
    raster = rasterise(points_cam, np.array([[0, 1, 2]]), K, SIZE, two_sided=True)
    hit = raster.face == 0
    seen = pixel_rays_cam(K, SIZE)[hit] * raster.depth[hit][:, None]
    np.testing.assert_allclose(raster.barycentric[hit] @ points_cam, seen, atol=1e-5)
    np.testing.assert_allclose(raster.barycentric[hit].sum(1), 1.0, atol=1e-6)
    assert hit.sum() > 1000


def test_common_sides_leave_no_pixel_out() -> None:
    """A square facing the camera, whose diagonals run through pixel centres."""
    n = 16
    x, y = np.meshgrid(np.linspace(-1, 1, n + 1), np.linspace(-1, 1, n + 1))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], axis=1)
    first = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).reshape(-1, 1)
    faces = np.concatenate([first + np.array(corners) for corners in ([0, 1, n + 2], [0, n + 2, n + 1])])
    K_even = np.array([[64.0, 0, 64.5], [0, 64.0, 64.5], [0, 0, 1]])
    raster = rasterise(points, faces, K_even, (129, 129), two_sided=True)
    assert (raster.face[33:96, 33:96] >= 0).all()
    np.testing.assert_allclose(raster.depth[33:96, 33:96], 2.0, rtol=1e-6)
    assert (raster.face >= 0).sum() <= 65**2


def test_closed_meshes_need_only_the_faces_that_look_at_the_camera() -> None:
    mesh = _mesh(trimesh.creation.torus(0.3, 0.1))
    both = render_mesh(mesh, K, T_CAM_FROM_OBJ, SIZE, PLAIN)
    one = render_mesh(
        mesh, K, T_CAM_FROM_OBJ, SIZE, Shading(two_sided=False, ambient=1.0, background_rgb=WHITE)
    )
    np.testing.assert_array_equal(both.face, one.face)
    np.testing.assert_array_equal(both.rgb, one.rgb)


def test_plain_colours_background_and_lamp() -> None:
    shape = trimesh.creation.icosphere(4, radius=0.4)
    mesh = SurfaceMesh(
        vertices=shape.vertices.astype(np.float32),
        faces=shape.faces.astype(np.int32),
        colors=np.tile(np.array([200, 100, 20], dtype=np.float32) / 255, (len(shape.vertices), 1)),
    )
    plain = render_mesh(mesh, K, T_CAM_FROM_OBJ, SIZE, PLAIN)
    assert np.unique(plain.rgb[plain.mask], axis=0).tolist() == [[200, 100, 20]]
    assert np.unique(plain.rgb[~plain.mask], axis=0).tolist() == [[255, 255, 255]]
    lit = render_mesh(
        mesh, K, T_CAM_FROM_OBJ, SIZE, Shading(two_sided=False, ambient=0.2, background_rgb=WHITE)
    )
    middle = K @ T_CAM_FROM_OBJ[:3, 3]
    row, column = int(middle[1] / middle[2]), int(middle[0] / middle[2])
    assert np.abs(lit.rgb[row, column].astype(int) - [200, 100, 20]).max() <= 1
    assert lit.rgb[lit.mask].min() < 20


def test_scale_in_the_transform_scales_the_depth_only() -> None:
    mesh = _mesh(trimesh.creation.icosphere(3, radius=0.4))
    T = np.diag([0.1, 0.1, 0.1, 1.0])
    metric = T_CAM_FROM_OBJ @ T
    metric[:3, 3] = 0.1 * T_CAM_FROM_OBJ[:3, 3]
    lit = Shading(two_sided=False, ambient=0.2, background_rgb=WHITE)
    canonical, scaled = (render_mesh(mesh, K, t, SIZE, lit) for t in (T_CAM_FROM_OBJ, metric))
    assert (canonical.rgb == scaled.rgb).mean() > 0.999
    np.testing.assert_allclose(scaled.depth, 0.1 * canonical.depth, rtol=1e-5)


def test_a_camera_inside_the_mesh_is_refused() -> None:
    mesh = _mesh(trimesh.creation.icosphere(2, radius=0.4))
    with pytest.raises(ModelError, match="not in front of the camera"):
        render_mesh(mesh, K, np.eye(4), SIZE, PLAIN)


def test_turntable_turns_once_and_keeps_the_mesh_in_the_image() -> None:
    shape = trimesh.creation.box((0.9, 0.3, 0.5))
    config = TurntableConfig(
        frames=8,
        size_px=64,
        supersampling=2,
        fov_rad=0.7,
        elevation_rad=0.35,
        shading=Shading(two_sided=False, ambient=0.3, background_rgb=WHITE),
    )
    mesh = _mesh(shape)
    frames = turntable(mesh, config)
    assert frames.shape == (8, 64, 64, 3)
    border = np.concatenate([frames[:, [0, -1]].reshape(-1, 3), frames[:, :, [0, -1]].reshape(-1, 3)])
    assert (border == 255).all()
    assert all((frame < 255).any() for frame in frames)
    # Turning the mesh by a quarter is two frames of eight.
    quarter = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = SurfaceMesh(
        vertices=(mesh.vertices @ quarter.T).astype(np.float32), faces=mesh.faces, colors=mesh.colors
    )
    difference = turntable(turned, config)[0].astype(int) - frames[2]
    assert (np.abs(difference) <= 2).mean() > 0.99
    assert np.abs(frames[0].astype(int) - frames[2]).mean() > 2
