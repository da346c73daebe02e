"""Which square of each frame the networks see: first a wide one, then one around what was found in it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from model.encoders.hand import HandNet
from model.encoders.hand_training import joint_positions
from model.video.frames import VideoFrame, VideoFrames
from model.video.square_crop import SquareWindow, box_from_masks, square_crop, square_window

__all__ = ["CloserCrop", "FrameCrop", "closer_crop", "cropped", "first_crops", "hand_regions"]


@dataclass(frozen=True, kw_only=True)
class CloserCrop:
    """When the second square is used: its side over that of the first one."""

    max_side_share: float  # above it there is nothing to gain
    min_side_share: float  # below it the masks are taken for a mistake


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameCrop:
    """The square of one frame, and where it comes from."""

    box_px: Float[np.ndarray, "4"] | None  # in the image; None: the largest centred square
    origin: Literal["centre", "given box", "predicted masks"]


def first_crops(frames: VideoFrames, boxes_px: Sequence[Float[np.ndarray, "4"]] | None) -> list[FrameCrop]:
    """The largest centred squares, or squares around the boxes given, one per frame."""
    if boxes_px is None:
        return [FrameCrop(box_px=None, origin="centre") for _ in frames.frames]
    return [FrameCrop(box_px=box, origin="given box") for box, _ in zip(boxes_px, frames.frames, strict=True)]


def cropped(
    frames: VideoFrames, crops: Sequence[FrameCrop], size: int
) -> tuple[Float32[np.ndarray, "view 3 size size"], tuple[SquareWindow, ...]]:
    """Images of `size` px, sRGB 0..1, and where they lie."""
    pairs = [square_crop(f.image, crop.box_px, size) for f, crop in zip(frames.frames, crops, strict=True)]
    return np.stack([image for image, _ in pairs]), tuple(window for _, window in pairs)


def closer_crop(
    frame: VideoFrame,
    crop: FrameCrop,
    found: Sequence[Bool[np.ndarray, "size size"]],
    margin: float,
    limits: CloserCrop,
) -> FrameCrop:
    """The square around what was `found` (hand, object) on the crop, if it is closer; else the same crop."""
    first = square_window(frame.image_size, crop.box_px, found[0].shape[0])
    box = box_from_masks(found, first, margin)
    if box is None:
        return crop
    share = square_window(frame.image_size, box, first.size).side_px / first.side_px
    if not limits.min_side_share <= share <= limits.max_side_share:
        return crop
    return FrameCrop(box_px=box, origin="predicted masks")


@torch.no_grad()
def hand_regions(
    network: HandNet, images: Float[Tensor, "view 3 size size"]
) -> list[Bool[np.ndarray, "size size"]]:
    """Convex hull of the 21 joints in each image, empty where no hand is seen.

    The hand's mask would do for a hand alone, but it takes in the forearm, which a crop need not hold.
    """
    output = network(images)
    side = images.shape[-1]
    joints = (joint_positions(output.joint_logits) * side).cpu().numpy()
    seen = (output.mask_logits > 0).flatten(1).any(1).tolist()
    regions = []
    for points, is_seen in zip(joints, seen):
        region = np.zeros((side, side), np.uint8)
        if is_seen:
            hull = cv2.convexHull(np.floor(points).astype(np.int32))
            cv2.fillConvexPoly(region, hull, (1.0,))
        regions.append(region.astype(bool))
    return regions
