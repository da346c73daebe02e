"""Frames, cameras and depth. The conventions of the whole project live here.

`T_b_from_a` maps points of frame a to frame b: x_b = T_b_from_a @ x_a, so equal
neighbours cancel. Cameras have OpenCV axes (x right, y down, z forward); `K` is in
pixels with the image corner at (0, 0), hence the first pixel centre at (0.5, 0.5).
World: Z up, metres. `depth` is z in the camera frame, `distance` is along the ray.
"""

import numpy as np

from shards.array_types import Bool, Float

__all__ = [
    "camera_center",
    "depth_from_distance",
    "distance_from_depth",
    "in_frustum",
    "intrinsics_from_fov",
    "invert_transform",
    "look_at",
    "pixel_centers",
    "pixel_rays_cam",
    "project_points",
    "transform_points",
    "unproject_depth",
]


def invert_transform(T_b_from_a: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 4 4"]:
    """`T_a_from_b` of a rigid transform: [R|t] -> [R'|-R't]. Scale is not supported."""
    R_a_from_b = np.swapaxes(T_b_from_a[..., :3, :3], -1, -2)
    T_a_from_b = np.zeros_like(T_b_from_a)
    T_a_from_b[..., :3, :3] = R_a_from_b
    T_a_from_b[..., :3, 3] = -np.einsum("...ij,...j->...i", R_a_from_b, T_b_from_a[..., :3, 3])
    T_a_from_b[..., 3, 3] = 1.0
    return T_a_from_b


def transform_points(
    T_b_from_a: Float[np.ndarray, "*batch 4 4"], points_a: Float[np.ndarray, "*batch point 3"]
) -> Float[np.ndarray, "*batch point 3"]:
    """x_b = T_b_from_a @ x_a for every point."""
    R, t = T_b_from_a[..., :3, :3], T_b_from_a[..., :3, 3]
    return np.einsum("...ij,...pj->...pi", R, points_a) + t[..., None, :]


def intrinsics_from_fov(fov_x_rad: float, image_size: tuple[int, int]) -> Float[np.ndarray, "3 3"]:
    """Pinhole `K` with square pixels and the principal point at the image centre.

    `fov_x_rad` is the full horizontal angle; `image_size` is (width, height) in pixels.
    """
    width, height = image_size
    focal = 0.5 * width / np.tan(0.5 * fov_x_rad)
    return np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])


def project_points(
    points_cam: Float[np.ndarray, "*batch 3"], K: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "*batch 2"]:
    """Camera-frame points to pixels: u = (K x) / x_z. NaN where x_z <= 0."""
    z = points_cam[..., 2:3]
    z = np.where(z > 0.0, z, np.nan)
    return points_cam[..., :2] / z * K[[0, 1], [0, 1]] + K[:2, 2]


def pixel_centers(image_size: tuple[int, int]) -> Float[np.ndarray, "height width 2"]:
    """(u, v) of every pixel centre; the first is (0.5, 0.5)."""
    width, height = image_size
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([u, v], axis=-1)


def pixel_rays_cam(
    K: Float[np.ndarray, "3 3"], image_size: tuple[int, int]
) -> Float[np.ndarray, "height width 3"]:
    """Ray of every pixel centre in the camera frame, scaled to z = 1 (not unit length)."""
    uv = pixel_centers(image_size)
    xy = (uv - K[:2, 2]) / K[[0, 1], [0, 1]]
    return np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)


def unproject_depth(
    depth: Float[np.ndarray, "height width"], K: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "height width 3"]:
    """Camera-frame point of every pixel centre, metres. Depth 0 (no surface) gives the origin."""
    height, width = depth.shape
    return pixel_rays_cam(K, (width, height)) * depth[..., None]


def distance_from_depth(
    depth: Float[np.ndarray, "height width"], K: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "height width"]:
    """z in the camera frame -> length along the ray."""
    height, width = depth.shape
    return depth * np.linalg.norm(pixel_rays_cam(K, (width, height)), axis=-1)


def depth_from_distance(
    distance: Float[np.ndarray, "height width"], K: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "height width"]:
    """Length along the ray -> z in the camera frame."""
    height, width = distance.shape
    return distance / np.linalg.norm(pixel_rays_cam(K, (width, height)), axis=-1)


def camera_center(T_cam_from_world: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 3"]:
    """Position of the camera in the world, metres."""
    return invert_transform(T_cam_from_world)[..., :3, 3]


def look_at(
    center_world: Float[np.ndarray, "*batch 3"],
    target_world: Float[np.ndarray, "*batch 3"],
    roll_rad: Float[np.ndarray, "*batch"] | float = 0.0,
) -> Float[np.ndarray, "*batch 4 4"]:
    """`T_cam_from_world` of a camera at `center_world` that looks at `target_world`.

    World +Z is up in the image; `roll_rad` then turns the camera about its own z axis.
    Undefined (ValueError) when the view direction is vertical to within 0.06 degrees.
    """
    forward = target_world - center_world
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, np.array([0.0, 0.0, 1.0]))
    length = np.linalg.norm(right, axis=-1, keepdims=True)
    if np.any(length < 1e-3):
        raise ValueError("look_at: the view direction is vertical, so 'up' is undefined")
    right = right / length
    down = np.cross(forward, right)
    c, s = np.cos(np.asarray(roll_rad))[..., None], np.sin(np.asarray(roll_rad))[..., None]
    R_cam_from_world = np.stack([c * right + s * down, -s * right + c * down, forward], axis=-2)
    T_cam_from_world = np.zeros((*R_cam_from_world.shape[:-2], 4, 4))
    T_cam_from_world[..., :3, :3] = R_cam_from_world
    T_cam_from_world[..., :3, 3] = -np.einsum("...ij,...j->...i", R_cam_from_world, center_world)
    T_cam_from_world[..., 3, 3] = 1.0
    return T_cam_from_world


def in_frustum(
    points_cam: Float[np.ndarray, "*batch 3"],
    K: Float[np.ndarray, "3 3"],
    image_size: tuple[int, int],
    margin_px: float = 0.0,
) -> Bool[np.ndarray, "*batch"]:
    """True where a point is in front of the camera and at least `margin_px` inside the image."""
    uv = project_points(points_cam, K)
    width, height = image_size
    low, high = margin_px, np.array([width, height]) - margin_px
    with np.errstate(invalid="ignore"):
        return np.all((uv >= low) & (uv <= high), axis=-1)
