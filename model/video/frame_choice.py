"""Which frames to reconstruct from: sharp ones that differ, spread over the video.

Farthest-point selection: each next frame is the one whose (least) difference to those already chosen,
times its sharpness, is largest. What stands still in a video cancels in the difference of two frames,
so that hand and object decide it. Nothing is drawn at random: equal frames go to the earliest.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from model.errors import ModelError
from model.video.frames import VideoFrames, scaled_down

__all__ = ["FrameChoice", "choose_frames", "relative_sharpness"]

_THUMBNAIL_PX = 32  # side of the images that are compared
_SHARPNESS_SIDE_PX = 512  # longest side: a blur that the encoders could not see does not count
_NOISE_SIGMA_PX = 1.0
_NEIGHBOURS = 4  # on each side; sharpness is compared within them, because it depends on what is shown
_LEAST_QUALITY = 0.1  # a blurred frame that is different still beats a repeated one
_TIME_WEIGHT = 0.5  # worth that frames lose which are next to each other
_EQUAL_DISTANCE = 1e-2  # of thumbnails, Lab units; what rounding leaves of 0
_ALIKE = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameChoice:
    """Chosen frames in the order of the source, with what decided."""

    positions: Int[np.ndarray, " chosen"]  # in VideoFrames.frames
    indices: Int[np.ndarray, " chosen"]  # in the source
    rank: Int[np.ndarray, " chosen"]  # 0: chosen first
    sharpness: Float[np.ndarray, " chosen"]  # 0..1, against the sharpest of the neighbouring candidates
    novelty: Float[np.ndarray, " chosen"]  # 0..1, least difference to those chosen before; 1 for the first

    def record(self) -> list[dict[str, float | int]]:
        """One entry per chosen frame, for reconstruction.json."""
        columns = zip(self.indices, self.rank, self.sharpness, self.novelty)
        return [
            {
                "index": int(index),
                "rank": int(rank),
                "sharpness": round(float(sharp), 4),
                "novelty": round(float(novel), 4),
            }
            for index, rank, sharp, novel in columns
        ]


def choose_frames(frames: VideoFrames, count: int) -> FrameChoice:
    """`count` informative frames, all of them if there are no more. ModelError for a count below 1."""
    if count < 1:
        raise ModelError("frames to choose", f"{count}", expected="1 or more", action="Change the number.")
    sharpness = relative_sharpness(frames.images)
    # The last term decides between frames that are all alike.
    difference = _differences(frames.images)
    worth = (difference + _ALIKE) * _spread(frames.indices, count)
    quality = _LEAST_QUALITY + (1.0 - _LEAST_QUALITY) * sharpness
    chosen = [int(np.argmax(quality))]
    novelty = [1.0]
    while len(chosen) < min(count, len(frames)):
        gain = worth[chosen].min(axis=0) * quality
        gain[chosen] = -1.0
        chosen.append(int(np.argmax(gain)))
        novelty.append(float(difference[chosen[:-1], chosen[-1]].min()))
    rank = np.argsort(chosen)
    positions = np.array(chosen)[rank]
    return FrameChoice(
        positions=positions,
        indices=frames.indices[positions],
        rank=rank,
        sharpness=sharpness[positions],
        novelty=np.array(novelty)[rank],
    )


def relative_sharpness(
    images: tuple[UInt8[np.ndarray, "_ _ 3"], ...],
) -> Float[np.ndarray, " frame"]:
    """Energy of the Laplacian where a frame differs from the median frame, over the best of its neighbours."""
    thumbnails = np.stack([_thumbnail(image) for image in images])
    changed = np.abs(thumbnails - np.median(thumbnails, axis=0)).sum(axis=-1)
    energy = np.array([_laplacian_energy(image, weight) for image, weight in zip(images, changed)])
    best = np.array([energy[max(0, i - _NEIGHBOURS) : i + _NEIGHBOURS + 1].max() for i in range(len(images))])
    return np.divide(energy, best, out=np.zeros_like(energy), where=best > 0)


def _laplacian_energy(
    image: UInt8[np.ndarray, "height width 3"], changed: Float32[np.ndarray, "thumb thumb"]
) -> float:
    """Mean squared Laplacian of the smoothed luminance, weighted by where the image changed."""
    small = scaled_down(image, _SHARPNESS_SIDE_PX)
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32)
    laplacian = cv2.Laplacian(cv2.GaussianBlur(grey, (0, 0), _NOISE_SIGMA_PX), cv2.CV_32F)
    # A floor lets the whole image count where nothing moves, and a little elsewhere.
    weight: np.ndarray = changed + np.float32(0.05 * changed.max() + 1e-3)
    weights = cv2.resize(weight, grey.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return float((weights * laplacian**2).sum() / weights.sum())


def _differences(images: tuple[UInt8[np.ndarray, "_ _ 3"], ...]) -> Float[np.ndarray, "frame frame"]:
    """0..1: d / (d + median d) of the thumbnails, so that outliers do not win by distance alone."""
    thumbnails = np.stack([_thumbnail(image) for image in images])
    thumbnails[..., 0] -= thumbnails[..., 0].mean(axis=(1, 2), keepdims=True)  # exposure is not content
    flat = thumbnails.reshape(len(images), -1).astype(np.float64)
    squares = (flat**2).sum(axis=1)
    distance = np.sqrt(np.maximum(squares[:, None] + squares - 2.0 * flat @ flat.T, 0.0))
    distance[distance < _EQUAL_DISTANCE] = 0.0
    positive = distance[distance > 0.0]
    return distance / (distance + np.median(positive)) if len(positive) else distance


def _spread(indices: Int[np.ndarray, " frame"], count: int) -> Float[np.ndarray, "frame frame"]:
    """1 for frames that an even spread would keep apart, less for closer ones."""
    fair = max(1.0, float(np.ptp(indices)) / max(1, count - 1))
    apart = np.minimum(1.0, np.abs(indices[:, None] - indices) / fair)
    return 1.0 - _TIME_WEIGHT * (1.0 - apart)


def _thumbnail(image: UInt8[np.ndarray, "height width 3"]) -> Float32[np.ndarray, "thumb thumb 3"]:
    """Lab, averaged; of any aspect ratio."""
    small = cv2.resize(image, (_THUMBNAIL_PX, _THUMBNAIL_PX), interpolation=cv2.INTER_AREA)
    lab = cv2.cvtColor(small.astype(np.float32) / 255.0, cv2.COLOR_RGB2Lab)
    return cv2.GaussianBlur(lab, (0, 0), 0.7)
