"""Distances: a camera path that holds every vertex in view, exactly, in every frame.

For a view rotation R and a target c, a vertex at p = R (x - c) is inside the image when
|p_x| <= s_x (p_z + D), with s the tangent of the half angle less the margin. The distance D needed
is therefore the maximum over vertices of |p_x| / s_x - p_z (and so for y and the near plane), and
any greater distance serves as well. The path uses a smooth upper envelope of it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import convolve1d, gaussian_filter1d, maximum_filter1d

from datagen.sampling.trajectories import ViewPath, view_rotations
from shards.geometry import intrinsics_from_fov, project_points, transform_points

__all__ = ["Framing", "Subject", "frame_subject", "image_drift_px", "image_margin_px"]

BISECTIONS = 10


@dataclass(frozen=True, kw_only=True)
class Subject:
    """What must stay in view. World, metres."""

    points_world: Float[np.ndarray, "frame point 3"]  # hand vertices and the object's hull vertices
    object_center_world: Float[np.ndarray, "frame 3"]
    fps: float


@dataclass(frozen=True, kw_only=True)
class Framing:
    """Limits of the image's composition."""

    image_size: tuple[int, int]
    margin_px: float
    near_m: float  # no vertex nearer than this
    max_drift_px: float  # of the object's centre from its mean place in the image
    smoothing_s: float  # time constant of target and distance


def frame_subject(
    subject: Subject, path: ViewPath, framing: Framing
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "frame 4 4"]]:
    """(K, T_cam_from_world per frame): all points inside with the margin, drift within the limit.

    The camera looks at a slow centre of the subject; only as far as the drift demands it follows
    the object itself (at full following the object's centre stays at the image centre).
    """
    K = intrinsics_from_fov(path.fov_rad, framing.image_size)
    R = view_rotations(path)
    points = np.einsum("tij,tpj->tpi", R, subject.points_world)
    center = subject.object_center_world
    slow = _slow_center(subject, framing.smoothing_s) + path.aim_world

    def solve(follow: float) -> tuple[Float[np.ndarray, "frame 4 4"], float]:
        target = center + (1.0 - follow) * (slow - center)
        T = _camera_poses(points, R, target, path, framing, K, subject.fps)
        return T, image_drift_px(center, K, T)

    T_cam_from_world, drift = solve(0.0)
    if drift <= framing.max_drift_px:
        return K, T_cam_from_world
    low, high = 0.0, 1.0
    T_cam_from_world, _ = solve(high)  # no drift at all
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        T, drift = solve(middle)
        if drift <= framing.max_drift_px:
            high, T_cam_from_world = middle, T
        else:
            low = middle
    return K, T_cam_from_world


def image_drift_px(
    object_center_world: Float[np.ndarray, "frame 3"],
    K: Float[np.ndarray, "3 3"],
    T_cam_from_world: Float[np.ndarray, "frame 4 4"],
) -> float:
    """Largest distance of the projected object centre from its mean over the clip, pixels."""
    uv = project_points(transform_points(T_cam_from_world, object_center_world[:, None])[:, 0], K)
    return float(np.linalg.norm(uv - uv.mean(axis=0), axis=-1).max())


def image_margin_px(
    points_world: Float[np.ndarray, "frame point 3"],
    K: Float[np.ndarray, "3 3"],
    T_cam_from_world: Float[np.ndarray, "frame 4 4"],
    image_size: tuple[int, int],
) -> float:
    """Smallest distance of a projected point to the image border over all frames; -inf behind the camera."""
    points_cam = transform_points(T_cam_from_world, points_world)
    if np.any(points_cam[..., 2] <= 0.0):
        return -np.inf
    uv = project_points(points_cam, K)
    return float(np.minimum(uv, np.asarray(image_size) - uv).min())


def _slow_center(subject: Subject, smoothing_s: float) -> Float[np.ndarray, "frame 3"]:
    points = subject.points_world
    middle = 0.5 * (points.min(axis=1) + points.max(axis=1))
    return gaussian_filter1d(middle, smoothing_s * subject.fps, axis=0, mode="nearest")


def _camera_poses(
    points: Float[np.ndarray, "frame point 3"],  # rotated by R, not shifted
    R_cam_from_world: Float[np.ndarray, "frame 3 3"],
    target_world: Float[np.ndarray, "frame 3"],
    path: ViewPath,
    framing: Framing,
    K: Float[np.ndarray, "3 3"],
    fps: float,
) -> Float[np.ndarray, "frame 4 4"]:
    target = np.einsum("tij,tj->ti", R_cam_from_world, target_world)
    half = 0.5 * np.asarray(framing.image_size) - framing.margin_px
    tangent = half / K[[0, 1], [0, 1]]
    z = points[..., 2] - target[:, None, 2]
    needed = np.maximum(
        np.abs(points[..., 0] - target[:, None, 0]) / tangent[0],
        np.abs(points[..., 1] - target[:, None, 1]) / tangent[1],
    )
    needed = np.maximum(needed, framing.near_m) - z
    distance = np.maximum(needed.max(axis=1), path.floor_distance_m)
    distance = _upper_envelope(distance, max(1, round(framing.smoothing_s * fps))) * path.slack

    T = np.zeros((len(points), 4, 4))
    T[:, :3, :3] = R_cam_from_world
    T[:, :3, 3] = -target
    T[:, 2, 3] += distance * (1.0 + 1e-9)  # rounding must not push the outermost vertex over the margin
    T[:, 3, 3] = 1.0
    return T


def _upper_envelope(values: Float[np.ndarray, " frame"], reach: int) -> Float[np.ndarray, " frame"]:
    """A smooth curve nowhere below `values`: the average of running maxima that all cover the frame."""
    window = 2 * reach + 1
    kernel = np.hanning(window + 2)[1:-1]
    highest = maximum_filter1d(values, window, mode="nearest")
    return convolve1d(highest, kernel / kernel.sum(), mode="nearest")
