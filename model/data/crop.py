"""Square crops with roll and mirror: pixels, K, pose and targets changed together.

A crop is one affine map of the image, applied in one resampling. It is always the image of a real
camera: turning the image about the crop's centre is a roll of the camera about its optical axis plus
a shift of the principal point, so `K` keeps square pixels and no skew. Mirroring is done to the world
(`mirrored`): x -> -x in every camera frame and in the canonical frame, so all views must share it.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from model.data.batch import SurfaceTarget, TrainingSample
from model.errors import ModelError
from shards.settings import Range
from shards.storage.images import MASK_BITS

__all__ = [
    "Augmentation",
    "CroppedMasks",
    "SquareCrop",
    "crop_image",
    "crop_masks",
    "draw_crop",
    "mirrored",
    "mirrored_surface",
    "union_box",
]

# Below this scale a bilinear sample skips pixels, so the image is averaged down first.
_AREA_BELOW_SCALE = 0.75
# Half of this value decides a mask pixel. It is even, so that two masks that exclude each other cannot
# both be above the half after rounding.
_MASK_VALUE = 254


@dataclass(frozen=True, kw_only=True)
class Augmentation:
    """How the square is drawn around hand and object, and how the image is varied."""

    # side of the square over the longest side of the (turned) boxes, >= 1
    margin: Annotated[tuple[float, float], Range(1, 100, rising=True)]
    shift: Annotated[float, Range(0, 1)]  # 0: boxes in the centre; 1: anywhere inside the square
    # turn of the camera, clockwise in the image
    roll_deg: Annotated[tuple[float, float], Range(-180, 180, rising=True)]
    flip_probability: Annotated[float, Range(0, 1)]

    def __post_init__(self) -> None:
        checks = (
            ("margin", 1.0 <= self.margin[0] <= self.margin[1], self.margin, "1 <= low <= high"),
            ("shift", 0.0 <= self.shift <= 1.0, self.shift, "0..1"),
            (
                "roll_deg",
                -180.0 <= self.roll_deg[0] <= self.roll_deg[1] <= 180.0,
                self.roll_deg,
                "-180 <= low <= high <= 180",
            ),
            ("flip_probability", 0.0 <= self.flip_probability <= 1.0, self.flip_probability, "0..1"),
        )
        for name, good, found, expected in checks:
            if not good:
                raise ModelError(
                    f"augmentation.{name}",
                    f"{found} is out of range",
                    expected=expected,
                    action="Change the configuration.",
                )

    def switched_off(self) -> "Augmentation":
        """The middle margin, centred, upright, never mirrored: for validation."""
        margin = 0.5 * (self.margin[0] + self.margin[1])
        return Augmentation(margin=(margin, margin), shift=0.0, roll_deg=(0.0, 0.0), flip_probability=0.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class SquareCrop:
    """A square of an image: crop_px = A_crop_from_image @ (u, v, 1)."""

    size: int  # px, of the result
    A_crop_from_image: Float[np.ndarray, "2 3"]

    def points(self, points_px: Float[np.ndarray, "*point 2"]) -> Float[np.ndarray, "*point 2"]:
        """Image pixels to crop pixels."""
        return points_px @ self.A_crop_from_image[:, :2].T + self.A_crop_from_image[:, 2]


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewCrop(SquareCrop):
    """A square of a view whose camera is known."""

    K: Float[np.ndarray, "3 3"]  # of the crop
    T_crop_from_cam: Float[np.ndarray, "4 4"]  # roll about the optical axis


@dataclass(frozen=True, kw_only=True, eq=False)
class CroppedMasks:
    """The masks the network is trained with."""

    object_amodal: Bool[np.ndarray, "size size"]
    object_visible: Bool[np.ndarray, "size size"]
    hand_visible: Bool[np.ndarray, "size size"]  # with forearm and sleeve


def union_box(boxes_px: Int[np.ndarray, "box 4"], image_size: tuple[int, int]) -> Float[np.ndarray, "4"]:
    """Box around the boxes that are not empty (-1); the whole image (width, height) if all are."""
    present = boxes_px[boxes_px[:, 2] > boxes_px[:, 0]]
    if len(present) == 0:
        return np.array([0, 0, *image_size], np.float64)
    return np.concatenate([present[:, :2].min(axis=0), present[:, 2:].max(axis=0)]).astype(np.float64)


def draw_crop(
    box_px: Float[np.ndarray, "4"],
    K: Float[np.ndarray, "3 3"],
    size: int,
    augmentation: Augmentation,
    rng: np.random.Generator,
) -> ViewCrop:
    """A random square that holds the whole box, turned. Always draws four numbers from `rng`."""
    margin = rng.uniform(*augmentation.margin)
    roll = np.deg2rad(rng.uniform(*augmentation.roll_deg))
    slack_x, slack_y = 0.5 * augmentation.shift * rng.uniform(-1.0, 1.0, 2)
    turn = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
    # Pixels that are not square could not be turned; the crop makes them square, of this focal length.
    focal = np.sqrt(K[0, 0] * K[1, 1])
    linear = turn @ np.diag([focal / K[0, 0], focal / K[1, 1]])

    x0, y0, x1, y1 = box_px
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]) @ linear.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    side = margin * float((high - low).max())
    center = 0.5 * (low + high) + np.array([slack_x, slack_y]) * (side - (high - low))
    scale = size / side
    offset = 0.5 * size - scale * center

    A = np.concatenate([scale * linear, offset[:, None]], axis=1)
    K_crop = np.diag([scale * focal, scale * focal, 1.0])
    K_crop[:2, 2] = A[:, :2] @ K[:2, 2] + offset  # where the optical axis meets the crop
    T_crop_from_cam = np.eye(4)
    T_crop_from_cam[:2, :2] = turn
    return ViewCrop(size=size, A_crop_from_image=A, K=K_crop, T_crop_from_cam=T_crop_from_cam)


def crop_image(
    rgb: UInt8[np.ndarray, "height width 3"], crop: SquareCrop
) -> UInt8[np.ndarray, "size size 3"]:
    """The pixels of the crop; black outside the image."""
    x0, y0, x1, y1 = _source_window(crop, rgb.shape)
    return _resampled(np.ascontiguousarray(rgb[y0:y1, x0:x1]), crop, (x0, y0))


def crop_masks(bits: UInt8[np.ndarray, "height width"], crop: SquareCrop) -> CroppedMasks:
    """Masks of the crop: where at least half of the (interpolated) source is inside.

    Visible stays within amodal and hand stays apart from object, as in the source.
    """
    x0, y0, x1, y1 = _source_window(crop, bits.shape)
    window = np.ascontiguousarray(bits[y0:y1, x0:x1])
    planes = _resampled(cv2.LUT(cv2.merge([window] * 3), _BITS_TO_PLANES), crop, (x0, y0))
    inside = planes > _MASK_VALUE // 2
    return CroppedMasks(
        object_amodal=inside[..., 0], object_visible=inside[..., 1], hand_visible=inside[..., 2]
    )


def mirrored(sample: TrainingSample) -> TrainingSample:
    """The sample seen in a mirror: its own inverse.

    With F = diag(-1, 1, 1, 1): x'_cam = F x_cam and x'_canonical = F x_canonical, so
    T' = F T F; a right hand becomes a left one. Arrays are views of the old ones where possible.
    """
    size = sample.images.shape[-1]
    F = np.diag([-1.0, 1.0, 1.0, 1.0]).astype(np.float32)
    K = sample.K.copy()
    K[:, 0, 2] = size - K[:, 0, 2]
    joints_px = sample.joints_px.copy()
    joints_px[..., 0] = size - joints_px[..., 0]
    return replace(
        sample,
        images=sample.images[..., ::-1],
        object_amodal=sample.object_amodal[..., ::-1],
        object_visible=sample.object_visible[..., ::-1],
        hand_visible=sample.hand_visible[..., ::-1],
        K=K,
        T_cam_from_canonical=F @ sample.T_cam_from_canonical @ F,
        occupancy=sample.occupancy[::-1],
        joints_px=joints_px,
        is_right=not sample.is_right,
        surface=None if sample.surface is None else mirrored_surface(sample.surface),
    )


def mirrored_surface(surface: SurfaceTarget) -> SurfaceTarget:
    """The surface of the object in the mirror, x -> -x: its own inverse."""
    F = np.array([-1.0, 1.0, 1.0], np.float32)
    return replace(
        surface,
        points=surface.points * F,
        normals=surface.normals * F,
        sdf_points=surface.sdf_points * F,
        is_mirrored=not surface.is_mirrored,
    )


def _source_window(crop: SquareCrop, shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """Source pixels (x0, y0, x1, y1) that the crop can touch, at least one."""
    (a, b), (c, d) = crop.A_crop_from_image[:, :2]
    # Written out: LAPACK wakes its threads for a 2 x 2 system, 2.5 ms on a busy machine.
    inverse = np.array([[d, -b], [-c, a]]) / (a * d - b * c)
    size = crop.size
    corners = np.array([[0, 0], [size, 0], [size, size], [0, size]], np.float64)
    source = (corners - crop.A_crop_from_image[:, 2]) @ inverse.T
    height, width = shape[:2]
    x0, y0 = np.clip(np.floor(source.min(axis=0)).astype(int) - 2, 0, [width - 1, height - 1])
    x1, y1 = np.clip(np.ceil(source.max(axis=0)).astype(int) + 2, [x0 + 1, y0 + 1], [width, height])
    return int(x0), int(y0), int(x1), int(y1)


def _resampled(
    window: UInt8[np.ndarray, "height width 3"], crop: SquareCrop, corner_px: tuple[int, int]
) -> UInt8[np.ndarray, "size size 3"]:
    """Bilinear where the crop enlarges, area average first where it shrinks."""
    height, width = window.shape[:2]
    step = np.ones(2)  # source pixels per pixel of `window`
    (a, b), (c, d) = crop.A_crop_from_image[:, :2]
    scale = float(np.sqrt(abs(a * d - b * c)))
    if scale < _AREA_BELOW_SCALE:
        small = (max(1, round(width * scale)), max(1, round(height * scale)))
        step = np.array([width, height]) / small
        window = cv2.resize(window, small, interpolation=cv2.INTER_AREA)
    linear = crop.A_crop_from_image[:, :2] * step
    offset = crop.A_crop_from_image[:, :2] @ np.array(corner_px, np.float64) + crop.A_crop_from_image[:, 2]
    offset = offset + linear @ np.array([0.5, 0.5]) - 0.5  # OpenCV counts from the first pixel centre
    A_opencv = np.concatenate([linear, offset[:, None]], axis=1)
    return cv2.warpAffine(
        window, A_opencv, (crop.size, crop.size), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
    )


def _bits_to_planes() -> UInt8[np.ndarray, "1 256 3"]:
    """Mask bits to one plane per mask of CroppedMasks."""
    bits = np.arange(256)
    object_amodal = bits & MASK_BITS["object_amodal"]
    object_visible = bits & MASK_BITS["object_visible"]
    hand_visible = bits & (MASK_BITS["hand_visible"] | MASK_BITS["arm_visible"])
    planes = np.stack([object_amodal, object_visible, hand_visible], axis=-1)
    return ((planes != 0) * _MASK_VALUE).astype(np.uint8)[None]


_BITS_TO_PLANES = _bits_to_planes()
