"""A lopsided object of few voxels, and its exact image: for tests that render again after a crop."""

import cv2
import numpy as np

from model.data.batch import OCCUPANCY_VOXELS
from shards.geometry import project_points, transform_points

FINE = 9  # silhouettes are drawn this much finer; odd, so that the middle of the fine pixels is the pixel's centre
# Corners are rounded to fine pixels (up to 0.71 of one), OpenCV also fills those that an outline touches
# (another 0.71), and distances are between their centres (1).
RENDER_ERROR_PX = 2.5 / FINE
_CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)


def lopsided_occupancy() -> np.ndarray:
    """Like no mirror image and no rotation of itself."""
    occupancy = np.zeros((OCCUPANCY_VOXELS,) * 3, bool)
    occupancy[4:60, 24:36, 26:38] = True
    occupancy[4:16, 24:60, 26:38] = True
    occupancy[48:60, 24:36, 26:58] = True
    occupancy[26:36, 8:24, 28:36] = True
    return occupancy


def voxel_centers_canonical(occupancy: np.ndarray) -> np.ndarray:
    """Centres of the occupied voxels in the unit cube."""
    return (np.argwhere(occupancy) + 0.5) / OCCUPANCY_VOXELS - 0.5


def render_mask(
    occupancy: np.ndarray, T_cam_from_canonical: np.ndarray, K: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Silhouette (bool): pixels whose centre is covered by an occupied voxel."""
    fine = _fine_silhouette(occupancy, T_cam_from_canonical, K, size)
    return fine[FINE // 2 :: FINE, FINE // 2 :: FINE].astype(bool)


def outline_distance_px(
    occupancy: np.ndarray, T_cam_from_canonical: np.ndarray, K: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """From each pixel centre to the outline of the silhouette, positive inside; right to RENDER_ERROR_PX."""
    fine = _fine_silhouette(occupancy, T_cam_from_canonical, K, size)
    inside = cv2.distanceTransform(fine, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    outside = cv2.distanceTransform(1 - fine, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return (inside - outside)[FINE // 2 :: FINE, FINE // 2 :: FINE] / FINE


def _fine_silhouette(
    occupancy: np.ndarray, T_cam_from_canonical: np.ndarray, K: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    K_fine = np.diag([FINE, FINE, 1.0]) @ K
    mask = np.zeros((size[1] * FINE, size[0] * FINE), np.uint8)
    for low, high in _bars(occupancy):
        corners = (low + _CORNERS * (high - low)) / OCCUPANCY_VOXELS - 0.5
        pixels = project_points(transform_points(T_cam_from_canonical, corners), K_fine) - 0.5
        cv2.fillConvexPoly(mask, cv2.convexHull(np.round(pixels).astype(np.int32)), [1])
    return mask


def _bars(occupancy: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Boxes (low, high) that the occupancy is the union of, grown greedily."""
    left, bars = occupancy.copy(), []
    while left.any():
        low = np.argwhere(left)[0]
        high = low + 1
        for axis in (0, 1, 2):
            while high[axis] < OCCUPANCY_VOXELS:
                grown = high.copy()
                grown[axis] += 1
                if not occupancy[tuple(slice(a, b) for a, b in zip(low, grown))].all():
                    break
                high = grown
        left[tuple(slice(a, b) for a, b in zip(low, high))] = False
        bars.append((low, high))
    return bars
