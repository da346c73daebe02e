"""The square that the network sees of a frame, and the way back onto the frame.

A square may reach beyond the image; there it is black, as in training. Pixels follow the project's
convention: the corner of the image is (0, 0), the centre of its first pixel (0.5, 0.5).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from model.data.crop import SquareCrop, crop_image
from model.errors import ModelError
from model.video.frames import VideoFrame

__all__ = [
    "SquareWindow",
    "box_from_masks",
    "mask_on_source",
    "parsed_box",
    "square_crop",
    "square_window",
]

# Connected pieces of a predicted mask smaller than this share of the largest one are stray pixels.
_STRAY_SHARE = 0.05


@dataclass(frozen=True, kw_only=True)
class SquareWindow:
    """A square of the image and the crop made of it: crop_px = (image_px - corner_px) * size / side_px."""

    corner_px: tuple[float, float]  # (x, y) in the image, may be negative
    side_px: float  # in the image
    size: int  # px of the crop

    @property
    def crop(self) -> SquareCrop:
        """What cuts it out."""
        scale, (x, y) = self.size / self.side_px, self.corner_px
        A = np.array([[scale, 0.0, -scale * x], [0.0, scale, -scale * y]])
        return SquareCrop(size=self.size, A_crop_from_image=A)

    def image_from_crop(self, points_px: Float[np.ndarray, "*point 2"]) -> Float[np.ndarray, "*point 2"]:
        """Crop pixels to image pixels."""
        return points_px * (self.side_px / self.size) + np.array(self.corner_px)


def square_window(
    image_size: tuple[int, int], box_px: Float[np.ndarray, "4"] | None, size: int
) -> SquareWindow:
    """The smallest square around the box (x0, y0, x1, y1), same centre; the largest centred one without."""
    if box_px is None:
        side = float(min(image_size))
        center = np.array(image_size) / 2.0
    else:
        side = float((box_px[2:] - box_px[:2]).max())
        center = 0.5 * (box_px[:2] + box_px[2:])
    x, y = (center - 0.5 * side).tolist()
    return SquareWindow(corner_px=(x, y), side_px=side, size=size)


def square_crop(
    image: UInt8[np.ndarray, "height width 3"],
    box_px: Float[np.ndarray, "4"] | None,
    size: int,
) -> tuple[Float32[np.ndarray, "3 size size"], SquareWindow]:
    """The crop, sRGB 0..1, resampled as in training, and where it lies."""
    window = square_window((image.shape[1], image.shape[0]), box_px, size)
    crop = crop_image(image, window.crop)
    return np.ascontiguousarray(crop.transpose(2, 0, 1), np.float32) / np.float32(255), window


def box_from_masks(
    masks: Sequence[Bool[np.ndarray, "size size"]], window: SquareWindow, margin: float
) -> Float[np.ndarray, "4"] | None:
    """Box in the image around hand and object as found on the crop, for a second, closer pass.

    `margin`: sides over those of the tight box, as the crops of training have it. None when nothing is
    found. Where a mask touches the edge of the crop the box reaches beyond it.
    """
    together = _without_strays(np.logical_or.reduce(masks))
    if not together.any():
        return None
    x, y = np.flatnonzero(together.any(axis=0)), np.flatnonzero(together.any(axis=1))
    corners = np.array([[x[0], y[0]], [x[-1] + 1, y[-1] + 1]], np.float64)
    low, high = window.image_from_crop(corners)
    center, half = 0.5 * (low + high), 0.5 * margin * (high - low)
    return np.concatenate([center - half, center + half])


def mask_on_source(
    mask: Float[np.ndarray, "size size"], window: SquareWindow, frame: VideoFrame
) -> Bool[np.ndarray, "source_height source_width"]:
    """A mask of the crop (probability, 0..1) on the frame at its source size; false outside the crop."""
    width, height = frame.source_size
    image_per_source = np.divide(frame.image_size, frame.source_size)
    scale = image_per_source * (window.size / window.side_px)  # crop pixels per source pixel
    offset = -np.array(window.corner_px) * (window.size / window.side_px)
    # OpenCV counts from the centre of the first pixel.
    A_crop_from_source = np.column_stack([np.diag(scale), offset + 0.5 * scale - 0.5])
    on_source = cv2.warpAffine(
        np.asarray(mask, np.float32),
        A_crop_from_source,
        (width, height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    # Replicated up to the crop's very edge, nothing beyond it.
    x = scale[0] * (np.arange(width) + 0.5) + offset[0]
    y = scale[1] * (np.arange(height) + 0.5) + offset[1]
    inside = ((y >= 0) & (y < window.size))[:, None] & (x >= 0) & (x < window.size)
    return inside & (on_source > 0.5)


def parsed_box(text: str, frame: VideoFrame) -> Float[np.ndarray, "4"]:
    """A box "x0,y0,x1,y1" in pixels of the source as pixels of the image. ModelError if it is none."""
    width, height = frame.source_size
    try:
        box = np.array([float(part) for part in text.split(",")])
    except ValueError:
        box = np.empty(0)
    if box.shape != (4,) or not np.isfinite(box).all():
        problem = "not four numbers"
    elif not (box[0] < box[2] and box[1] < box[3]):
        problem = "no area"
    elif box[0] >= width or box[1] >= height or box[2] <= 0 or box[3] <= 0:
        problem = "outside of the image"
    else:
        return box * np.tile(np.divide(frame.image_size, frame.source_size), 2)
    raise ModelError(
        f"box '{text}'",
        problem,
        expected=f"x0,y0,x1,y1 in pixels within {width} x {height}, x0 < x1 and y0 < y1",
        action="Draw it around hand and object.",
    )


def _without_strays(mask: Bool[np.ndarray, "size size"]) -> Bool[np.ndarray, "size size"]:
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if count <= 2:
        return mask
    areas = stats[:, cv2.CC_STAT_AREA]
    kept = areas >= _STRAY_SHARE * areas[1:].max()
    kept[0] = False
    return kept[labels]
