"""OpenCV cameras to Blender cameras. The only file that knows Blender's camera axes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from shards.geometry import invert_transform

__all__ = ["SENSOR_WIDTH_MM", "BlenderLens", "blender_lens", "world_from_blender_camera"]

SENSOR_WIDTH_MM = 36.0

# Blender's camera looks along -z with y up; ours along +z with y down.
_CV_FROM_BLENDER = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class BlenderLens:
    """Settings of a Blender camera with horizontal sensor fit and `SENSOR_WIDTH_MM`."""

    focal_mm: float
    shift_x: float  # in image widths
    shift_y: float  # in image widths
    pixel_aspect_x: float
    pixel_aspect_y: float


def world_from_blender_camera(T_cam_from_world: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """`matrix_world` of the Blender camera object that sees what the OpenCV camera sees."""
    return invert_transform(T_cam_from_world) @ _CV_FROM_BLENDER


def blender_lens(K: Float[np.ndarray, "3 3"], image_size: tuple[int, int]) -> BlenderLens:
    """Lens of an OpenCV `K` (pixels, image corner (0, 0)); any principal point, fx and fy may differ.

    Raises ValueError for skew, a non-positive focal length or a last row other than (0, 0, 1).
    """
    width, height = image_size
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    if K[0, 1] != 0.0 or K[1, 0] != 0.0 or not np.array_equal(K[2], [0.0, 0.0, 1.0]):
        raise ValueError(f"K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], not {K.tolist()}")
    if not (fx > 0.0 and fy > 0.0):
        raise ValueError(f"K needs positive focal lengths, not fx={fx}, fy={fy}")
    # A pixel is pixel_aspect_x wide and pixel_aspect_y high; Blender wants both >= 1.
    aspect_y = fx / fy
    return BlenderLens(
        focal_mm=float(SENSOR_WIDTH_MM * fx / width),
        shift_x=float((0.5 * width - cx) / width),
        shift_y=float((cy - 0.5 * height) / width * aspect_y),
        pixel_aspect_x=float(max(1.0, 1.0 / aspect_y)),
        pixel_aspect_y=float(max(1.0, aspect_y)),
    )
