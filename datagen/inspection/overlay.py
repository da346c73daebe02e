"""Labels drawn over an image: mask contours, projected joints, object axes."""

from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from shards.geometry import project_points, transform_points
from shards.joints import DIGIT_JOINTS, JOINTS
from shards.storage.images import Masks

__all__ = ["draw_labels"]

# RGB. Amodal contours are thin and pale, visible ones full; axes are x red, y green, z blue.
OBJECT_COLOR, HAND_COLOR, ARM_COLOR = (255, 190, 40), (60, 200, 255), (150, 150, 160)
BONES = [
    bone
    for digit in ("index", "middle", "ring", "pinky", "thumb")
    for bone in pairwise((0, *DIGIT_JOINTS[digit], JOINTS.index(f"{digit}_tip")))
]
DIGIT_COLORS = ((90, 220, 90), (220, 220, 80), (250, 150, 70), (230, 90, 200), (240, 70, 70))


def draw_labels(
    rgb: UInt8[np.ndarray, "height width 3"],
    masks: Masks,
    joints_px: Float[np.ndarray, "21 2"],
    T_cam_from_obj: Float[np.ndarray, "4 4"],
    K: Float[np.ndarray, "3 3"],
    axis_length_m: float,
    *,
    zoom: int = 1,
) -> UInt8[np.ndarray, "tall wide 3"]:
    """A copy of the image, enlarged by `zoom`, with its labels on it."""
    height, width = rgb.shape[:2]
    size = (width * zoom, height * zoom)
    canvas = np.ascontiguousarray(cv2.resize(rgb, size, interpolation=cv2.INTER_CUBIC))
    for mask, color, thickness in (
        (masks.arm_visible, ARM_COLOR, 1),
        (masks.hand_amodal, _pale(HAND_COLOR), 1),
        (masks.object_amodal, _pale(OBJECT_COLOR), 1),
        (masks.hand_visible, HAND_COLOR, 1),
        (masks.object_visible, OBJECT_COLOR, 2 if zoom > 1 else 1),
    ):
        large = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        contours, _ = cv2.findContours(large, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(canvas, contours, -1, color, thickness)
    _draw_joints(canvas, joints_px * zoom)
    _draw_axes(canvas, T_cam_from_obj, K, axis_length_m, zoom)
    return canvas


def _draw_joints(canvas: UInt8[np.ndarray, "height width 3"], joints_px: Float[np.ndarray, "21 2"]) -> None:
    for number, (a, b) in enumerate(BONES):
        if not np.isnan(joints_px[[a, b]]).any():
            start, end = np.round(joints_px[[a, b]] - 0.5).astype(int).tolist()
            cv2.line(canvas, start, end, DIGIT_COLORS[number // 4], 1, cv2.LINE_AA)


def _draw_axes(
    canvas: UInt8[np.ndarray, "height width 3"],
    T_cam_from_obj: Float[np.ndarray, "4 4"],
    K: Float[np.ndarray, "3 3"],
    length_m: float,
    zoom: int,
) -> None:
    ends_obj = np.concatenate([np.zeros((1, 3)), length_m * np.eye(3)])
    ends = project_points(transform_points(T_cam_from_obj, ends_obj), K) * zoom
    if np.isnan(ends).any():
        return
    origin = (round(ends[0, 0]), round(ends[0, 1]))
    for axis, color in enumerate(((235, 40, 40), (40, 200, 60), (60, 90, 255))):
        cv2.arrowedLine(
            canvas, origin, (round(ends[1 + axis, 0]), round(ends[1 + axis, 1])), color, 2, cv2.LINE_AA
        )


def _pale(color: tuple[int, int, int]) -> tuple[int, int, int]:
    r, g, b = (int(0.5 * channel + 110) for channel in color)
    return r, g, b
