"""Geometry buffers against analytic surfaces and the drawn meshes."""

import igl
import numpy as np
import trimesh

from datagen.annotation.annotate import (
    ARM_AMODAL,
    ARM_VISIBLE,
    HAND_AMODAL,
    HAND_VISIBLE,
    OBJECT_AMODAL,
    OBJECT_VISIBLE,
    MotionGeometry,
    annotate_frame,
    hand_object_distances,
)
from datagen.geometry.raycast import TriangleCaster, cast_window, projected_window
from datagen.scene.table_mesh import inside_flat_top, table_mesh
from shards.geometry import (
    in_frustum,
    invert_transform,
    look_at,
    pixel_rays_cam,
    project_points,
    transform_points,
    unproject_depth,
)
from tests.datagen.annotation.annotated_scenes import SIZE, TABLE, K, bumpy_ball, make_hand_scene, make_scene


def test_depth_of_a_box_is_exact():
    """A box is its triangles, so its depth has a closed form: the slab test."""
    box = trimesh.creation.box((0.1, 0.06, 0.08))
    T_cam_from_box = look_at(np.array([0.3, 0.2, 0.25]), np.array([0.0, 0.01, 0.0]), 0.3)
    caster = TriangleCaster(np.array(box.vertices), np.array(box.faces))
    window = projected_window(caster.verts, T_cam_from_box, K, SIZE)
    depth = np.full(SIZE[::-1], np.inf)
    depth[window.slices] = cast_window(caster, T_cam_from_box, K, window).depth
    T_box_from_cam = invert_transform(T_cam_from_box)
    rays = pixel_rays_cam(K, SIZE) @ T_box_from_cam[:3, :3].T
    half = np.array([0.05, 0.03, 0.04])
    with np.errstate(divide="ignore"):
        planes = np.stack([(s * half - T_box_from_cam[:3, 3]) / rays for s in (-1.0, 1.0)])
    enter, leave = planes.min(axis=0).max(axis=-1), planes.max(axis=0).min(axis=-1)
    expected = np.where(enter <= leave, enter, np.inf)
    hit = np.isfinite(expected)
    assert 300 < hit.sum() < hit.size
    np.testing.assert_array_equal(np.isfinite(depth), hit)
    np.testing.assert_allclose(depth[hit], expected[hit], rtol=1e-12)


def test_depth_of_a_sphere_approaches_the_sphere():
    radius = 0.06
    ball = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    eye = np.array([0.3, 0.1, 0.2])
    T_cam_from_world = look_at(eye, np.zeros(3))
    caster = TriangleCaster(np.array(ball.vertices), np.array(ball.faces))
    window = projected_window(caster.verts, T_cam_from_world, K, SIZE)
    depth = np.full(SIZE[::-1], np.inf)
    depth[window.slices] = cast_window(caster, T_cam_from_world, K, window).depth
    rays, center = pixel_rays_cam(K, SIZE), T_cam_from_world[:3, 3]
    a, b = np.sum(rays**2, axis=-1), rays @ center
    root = b**2 - a * (center @ center - radius**2)
    expected = np.where(root > 0.0, (b - np.sqrt(np.maximum(root, 0.0))) / a, np.inf)
    both = np.isfinite(depth) & np.isfinite(expected)
    assert np.mean(np.isfinite(depth) == np.isfinite(expected)) > 0.999
    inner = both & (root > 0.1 * root.max())  # away from the silhouette
    assert np.abs(depth[inner] - expected[inner]).max() < 1e-4


def test_unprojected_depth_lies_on_the_drawn_surfaces():
    scene = make_scene(bumpy_ball())
    geometry = MotionGeometry(scene)
    for frame in range(2):
        for camera, buffers in zip(scene.cameras, annotate_frame(geometry, frame)):
            T_world_from_cam = invert_transform(camera.T_cam_from_world[frame])
            points = transform_points(
                T_world_from_cam, unproject_depth(buffers.depth.astype(float), camera.K).reshape(-1, 3)
            )
            masks = buffers.masks.reshape(-1)
            obj = trimesh.Trimesh(
                transform_points(scene.T_world_from_obj[frame], scene.object_mesh.verts_obj),
                scene.object_mesh.faces,
                process=False,
            )
            hand = trimesh.Trimesh(scene.hand_verts_world[frame], scene.hand_surface.faces, process=False)
            slab = table_mesh(TABLE)
            table = trimesh.Trimesh(slab.verts_world, slab.faces, process=False)
            nothing = (masks & (HAND_VISIBLE | OBJECT_VISIBLE | ARM_VISIBLE)) == 0
            on_table = nothing & (buffers.depth.reshape(-1) > 0)
            for mesh, chosen in (
                (obj, (masks & OBJECT_VISIBLE) > 0),
                (hand, (masks & (HAND_VISIBLE | ARM_VISIBLE)) > 0),
                (table, on_table),
            ):
                assert chosen.sum() > 50
                some = points[chosen][:: max(1, chosen.sum() // 300)]
                squared, _, _ = igl.point_mesh_squared_distance(
                    some, np.array(mesh.vertices), np.array(mesh.faces)
                )
                assert np.sqrt(squared.max()) < 1e-6


def test_visible_is_a_subset_of_amodal_and_everything_adds_up():
    scene = make_scene(bumpy_ball())
    for buffers in annotate_frame(MotionGeometry(scene), 1):
        masks = buffers.masks
        for part, visible, amodal in (
            (buffers.hand, HAND_VISIBLE, HAND_AMODAL),
            (buffers.object, OBJECT_VISIBLE, OBJECT_AMODAL),
            (buffers.arm, ARM_VISIBLE, ARM_AMODAL),
        ):
            seen, whole = (masks & visible) > 0, (masks & amodal) > 0
            assert not np.any(seen & ~whole)
            assert 0 < part.pixels_visible == seen.sum() <= part.pixels_amodal == whole.sum()
            for box, mask in ((part.box_visible_px, seen), (part.box_amodal_px, whole)):
                rows, columns = np.nonzero(mask)
                np.testing.assert_array_equal(
                    box, [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
                )
        # One surface at most is the visible one, and it is in the depth.
        n_visible = sum(
            ((masks & bit) > 0).astype(int) for bit in (HAND_VISIBLE, OBJECT_VISIBLE, ARM_VISIBLE)
        )
        assert n_visible.max() == 1
        assert np.all(buffers.depth[n_visible == 1] > 0)
        whole = (masks & OBJECT_AMODAL) > 0
        np.testing.assert_array_equal(buffers.depth_object > 0, whole)
        assert np.all(buffers.depth[whole] <= buffers.depth_object[whole])
        np.testing.assert_array_equal(
            buffers.depth[(masks & OBJECT_VISIBLE) > 0], buffers.depth_object[(masks & OBJECT_VISIBLE) > 0]
        )
        lengths = np.linalg.norm(buffers.normals_cam, axis=-1)
        np.testing.assert_allclose(lengths[buffers.depth > 0], 1.0, atol=1e-5)
        assert np.all(lengths[buffers.depth == 0] == 0)
        rays = pixel_rays_cam(K, SIZE)
        assert np.all(np.sum(rays * buffers.normals_cam, axis=-1) <= 1e-6)  # every normal faces the camera


def test_hidden_object_has_an_amodal_mask_only():
    scene = make_scene(trimesh.creation.icosphere(subdivisions=2, radius=0.01), eyes=((0.6, 0.05, 0.27),))
    (buffers,) = annotate_frame(MotionGeometry(scene), 1)
    assert buffers.object.pixels_amodal > 0
    assert buffers.object.pixels_visible == 0
    assert buffers.object.visible_fraction == 0.0
    np.testing.assert_array_equal(buffers.object.box_visible_px, [-1] * 4)


def test_closed_form_table_equals_its_mesh():
    """The same image whether the flat top is met in closed form or by rays."""
    slab = table_mesh(TABLE)
    as_mesh = trimesh.Trimesh(slab.verts_world, slab.faces, process=False)
    assert as_mesh.is_watertight
    assert as_mesh.volume > 0
    caster = TriangleCaster(slab.verts_world, slab.faces)
    for eye in (
        (0.55, 0.1, 0.45),
        (0.1, -0.05, 0.9),
        (0.5, 0.3, 0.12),
        (0.4, 0.3, 0.05),
        (-0.12, -0.1, 0.13),
    ):
        scene = make_scene(bumpy_ball(), eyes=(eye,))
        camera = scene.cameras[0]
        (buffers,) = annotate_frame(MotionGeometry(scene), 0)
        window = projected_window(slab.verts_world, camera.T_cam_from_world[0], camera.K, SIZE)
        depth = np.full(SIZE[::-1], np.inf)
        depth[window.slices] = cast_window(caster, camera.T_cam_from_world[0], camera.K, window).depth
        bare = (buffers.masks & (HAND_AMODAL | OBJECT_AMODAL | ARM_AMODAL)) == 0
        expected = np.where(np.isfinite(depth), depth, 0.0)
        assert np.mean((buffers.depth > 0)[bare] == (expected > 0)[bare]) > 0.999
        both = bare & (buffers.depth > 0) & (expected > 0)
        np.testing.assert_allclose(buffers.depth[both], expected[both], rtol=2e-6)


def test_flat_top_is_the_polygon_of_the_mesh():
    slab = table_mesh(TABLE)
    top = slab.verts_world[np.isclose(slab.verts_world[:, 2], TABLE.top_z_m, atol=1e-12)]
    c, s = np.cos(TABLE.yaw_rad), np.sin(TABLE.yaw_rad)
    x, y = ((top[:, :2] - TABLE.center_xy_m) @ np.array([[c, -s], [s, c]])).T
    assert inside_flat_top(TABLE, 0.9999 * x, 0.9999 * y).all()
    corners = np.hypot(x, y) > 0.01  # all but the pole in the middle
    assert not inside_flat_top(TABLE, 1.0001 * x[corners], 1.0001 * y[corners]).any()


def test_a_surface_behind_the_camera_is_not_seen():
    """The window falls back to the whole image; what is in front is still exact."""
    scene = make_scene(bumpy_ball(), eyes=((0.24, 0.03, 0.42),))  # beside the rod, part of it behind
    (buffers,) = annotate_frame(MotionGeometry(scene), 0)
    points = transform_points(scene.cameras[0].T_cam_from_world[0], scene.hand_verts_world[0])
    assert points[:, 2].min() < 0.1
    seen = in_frustum(points, K, SIZE)
    assert seen.any()
    assert buffers.depth[buffers.depth > 0].min() > 0


def test_every_projected_vertex_is_inside_the_amodal_mask():
    scene = make_scene(bumpy_ball(), size=(640, 480))
    for camera, buffers in zip(scene.cameras, annotate_frame(MotionGeometry(scene), 1)):
        T_cam_from_obj = camera.T_cam_from_world[1] @ scene.T_world_from_obj[1]
        # Points well inside the body cannot fall beside its mask.
        uv = project_points(transform_points(T_cam_from_obj, 0.8 * scene.object_mesh.verts_obj), camera.K)
        column, row = np.floor(uv).astype(int).T
        assert np.all(buffers.masks[row, column] & OBJECT_AMODAL)


def test_hand_object_distance_is_signed():
    scene = make_scene(trimesh.creation.icosphere(subdivisions=4, radius=0.05))
    hand = scene.hand_verts_world[:, : scene.hand_surface.n_hand_verts]
    expected = np.linalg.norm(hand - scene.T_world_from_obj[:, None, :3, 3], axis=-1).min(axis=1) - 0.05
    np.testing.assert_allclose(hand_object_distances(scene), expected, atol=2e-4)
    deep = make_scene(trimesh.creation.icosphere(subdivisions=4, radius=0.08))
    assert np.all(hand_object_distances(deep) < -0.01)


def test_annotation_repeats_to_the_last_bit():
    scene = make_scene(bumpy_ball())
    first, second = (annotate_frame(MotionGeometry(scene), 1)[0] for _ in range(2))
    for name in ("depth", "depth_object", "normals_cam", "masks"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_joints_project_inside_the_amodal_hand():
    scene, joints_world = make_hand_scene((320, 240))
    geometry = MotionGeometry(scene)
    for frame in range(2):
        for camera, buffers in zip(scene.cameras, annotate_frame(geometry, frame)):
            joints_cam = transform_points(camera.T_cam_from_world[frame], joints_world[frame])
            inside = in_frustum(joints_cam, camera.K, camera.image_size)
            column, row = np.floor(project_points(joints_cam[inside], camera.K)).astype(int).T
            # The wrist joint lies in the plane where hand and arm meet; tips lie on the surface.
            body = (buffers.masks & (HAND_AMODAL | ARM_AMODAL)) > 0
            near = np.stack([np.roll(body, (dy, dx), (0, 1)) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]).any(
                axis=0
            )
            assert inside.sum() >= 15
            assert near[row, column].all()
