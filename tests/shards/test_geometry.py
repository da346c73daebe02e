"""Frames, cameras and depth: identities that must hold for any camera."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from shards import geometry

coordinates = st.floats(-5.0, 5.0, allow_nan=False)
points = hnp.arrays(np.float64, (7, 3), elements=coordinates)
image_sizes = st.tuples(st.integers(2, 40), st.integers(2, 40))
fovs = st.floats(0.1, 2.5)


@st.composite
def transforms(draw):
    """A rigid transform from a random axis and angle."""
    axis = np.array(draw(st.tuples(*[st.floats(-1, 1)] * 3))) + np.array([0.0, 0.0, 1.5])
    axis /= np.linalg.norm(axis)
    angle = draw(st.floats(-3.1, 3.1))
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    T = np.eye(4)
    T[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    T[:3, 3] = draw(st.tuples(coordinates, coordinates, coordinates))
    return T


@st.composite
def views(draw):
    """(center, target) with a view direction that is not vertical."""
    target = np.array(draw(st.tuples(coordinates, coordinates, coordinates)))
    azimuth, elevation = draw(st.floats(-3.1, 3.1)), draw(st.floats(-1.4, 1.4))
    direction = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    return target + draw(st.floats(0.1, 10.0)) * np.array(direction), target


@given(transforms(), points)
def test_a_transform_and_its_inverse_cancel(T_b_from_a, points_a):
    T_a_from_b = geometry.invert_transform(T_b_from_a)
    back = geometry.transform_points(T_a_from_b, geometry.transform_points(T_b_from_a, points_a))
    np.testing.assert_allclose(back, points_a, atol=1e-12)
    np.testing.assert_allclose(T_a_from_b @ T_b_from_a, np.eye(4), atol=1e-12)


@given(transforms(), transforms(), points)
def test_equal_neighbours_cancel(T_c_from_b, T_b_from_a, points_a):
    in_two_steps = geometry.transform_points(T_c_from_b, geometry.transform_points(T_b_from_a, points_a))
    np.testing.assert_allclose(
        geometry.transform_points(T_c_from_b @ T_b_from_a, points_a), in_two_steps, atol=1e-9
    )


@given(fovs, image_sizes)
def test_projection_undoes_unprojection(fov_x_rad, image_size):
    width, height = image_size
    K = geometry.intrinsics_from_fov(fov_x_rad, image_size)
    depth = np.random.default_rng(0).uniform(0.1, 9.0, (height, width))
    points_cam = geometry.unproject_depth(depth, K)
    np.testing.assert_allclose(
        geometry.project_points(points_cam, K), geometry.pixel_centers(image_size), atol=1e-8
    )
    np.testing.assert_allclose(points_cam[..., 2], depth)


@given(fovs, image_sizes)
def test_depth_and_distance_convert_both_ways(fov_x_rad, image_size):
    width, height = image_size
    K = geometry.intrinsics_from_fov(fov_x_rad, image_size)
    depth = np.random.default_rng(0).uniform(0.1, 9.0, (height, width))
    distance = geometry.distance_from_depth(depth, K)
    np.testing.assert_allclose(distance, np.linalg.norm(geometry.unproject_depth(depth, K), axis=-1))
    np.testing.assert_allclose(geometry.depth_from_distance(distance, K), depth)
    assert np.all(distance >= depth)


def test_depth_is_z_and_not_ray_length():
    K = geometry.intrinsics_from_fov(np.pi / 2, (2, 2))
    corner = geometry.distance_from_depth(np.ones((2, 2)), K)[0, 0]
    assert corner == pytest.approx(np.sqrt(1 + 0.5**2 + 0.5**2))


@given(views())
def test_look_at_puts_the_target_on_the_axis_and_up_upward(view):
    center_world, target_world = view
    T_cam_from_world = geometry.look_at(center_world, target_world)
    target_cam = geometry.transform_points(T_cam_from_world, target_world[None])[0]
    np.testing.assert_allclose(
        target_cam, [0.0, 0.0, float(np.linalg.norm(target_world - center_world))], atol=1e-9
    )
    np.testing.assert_allclose(geometry.camera_center(T_cam_from_world), center_world, atol=1e-9)
    assert (T_cam_from_world[:3, :3] @ [0, 0, 1])[1] < 0  # image y runs down
    assert np.linalg.det(T_cam_from_world[:3, :3]) == pytest.approx(1.0)


def test_look_at_refuses_a_vertical_view():
    with pytest.raises(ValueError, match="vertical"):
        geometry.look_at(np.array([0.0, 0.0, 1.0]), np.zeros(3))


def test_the_image_corner_is_zero_and_the_first_pixel_centre_one_half():
    np.testing.assert_array_equal(geometry.pixel_centers((3, 2))[0, 0], [0.5, 0.5])
    np.testing.assert_array_equal(geometry.pixel_centers((3, 2))[-1, -1], [2.5, 1.5])
    K = geometry.intrinsics_from_fov(np.pi / 2, (4, 4))
    np.testing.assert_allclose(
        geometry.project_points(np.array([-1.0, -1.0, 1.0]), K), [0.0, 0.0], atol=1e-12
    )


def test_points_behind_the_camera_project_to_nan_and_are_outside():
    K = geometry.intrinsics_from_fov(1.0, (4, 4))
    behind = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    assert np.isnan(geometry.project_points(behind, K)[0]).all()
    np.testing.assert_array_equal(geometry.in_frustum(behind, K, (4, 4)), [False, True])


def test_the_margin_narrows_the_frustum():
    K = geometry.intrinsics_from_fov(np.pi / 2, (100, 100))
    near_border = geometry.unproject_depth(np.ones((100, 100)), K)[0, :1]
    assert geometry.in_frustum(near_border, K, (100, 100)).all()
    assert not geometry.in_frustum(near_border, K, (100, 100), margin_px=1.0).any()
