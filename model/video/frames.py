"""VideoFrames: the images that a reconstruction starts from, upright sRGB, and what was done to them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Int, UInt8

from model.errors import ModelError

__all__ = [
    "DEINTERLACED",
    "FIRST_ONLY",
    "NOTED_CHANGES",
    "TRANSPARENT",
    "TURNED_BY_EXIF",
    "ReadLimits",
    "VideoFrame",
    "VideoFrames",
    "checked_indices",
    "even_positions",
    "over_black",
    "scaled_down",
    "scaled_size",
]

# Changes of a frame that a user should know, not only the record: NOTED_CHANGES, and turns that differ.
DEINTERLACED = "deinterlaced"
FIRST_ONLY = "only the first image of the file used"
TRANSPARENT = "transparency laid over black"
TURNED_BY_EXIF = "turned upright as EXIF data say"
NOTED_CHANGES = (DEINTERLACED, FIRST_ONLY, TRANSPARENT)


@dataclass(frozen=True, kw_only=True)
class ReadLimits:
    """What may be held in memory at once: about max_frames * max_side_px^2 * 3 bytes."""

    max_frames: int  # candidates, spread evenly over the source; not for frames asked for by index
    max_side_px: int  # larger images are scaled down while they are decoded

    def __post_init__(self) -> None:
        for name in ("max_frames", "max_side_px"):
            if getattr(self, name) < 1:
                raise ModelError(
                    f"limits.{name}",
                    f"{getattr(self, name)} is too small",
                    expected="1 or more",
                    action="Raise it.",
                )


@dataclass(frozen=True, kw_only=True, eq=False)
class VideoFrame:
    """One image, upright, with square pixels."""

    image: UInt8[np.ndarray, "height width 3"]  # sRGB
    index: int  # place in the source, from 0
    time_s: float  # from the first frame; NaN where the source has no clock
    name: str
    source_size: tuple[int, int]  # (width, height) in px before scaling, upright
    changes: tuple[str, ...]  # what was done to it

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) in px of `image`."""
        return self.image.shape[1], self.image.shape[0]


@dataclass(frozen=True, kw_only=True, eq=False)
class VideoFrames:
    """Frames of one source in its order. Images of a folder may differ in size."""

    source: str
    kind: Literal["video", "images", "clip"]
    frames: tuple[VideoFrame, ...]
    n_source_frames: int
    notes: tuple[str, ...]  # what the user should know: files left out, one frame only, ...

    def __post_init__(self) -> None:
        if not self.frames:
            raise ModelError(
                self.source, "no frame", expected="at least one image", action="Choose another input."
            )

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def images(self) -> tuple[UInt8[np.ndarray, "height width 3"], ...]:
        return tuple(frame.image for frame in self.frames)

    @property
    def indices(self) -> Int[np.ndarray, " frame"]:
        """Places in the source."""
        return np.array([frame.index for frame in self.frames])

    @property
    def changes(self) -> tuple[str, ...]:
        """What was done, each with the number of frames."""
        counts = Counter(change for frame in self.frames for change in frame.changes)
        return tuple(f"{change} ({count} of {len(self)} frames)" for change, count in counts.items())

    def select(self, positions: Sequence[int] | Int[np.ndarray, " chosen"]) -> "VideoFrames":
        """Only the frames at these positions of `frames`."""
        return replace(self, frames=tuple(self.frames[int(position)] for position in positions))


def even_positions(n: int, limit: int) -> list[int]:
    """All of n positions, or the middles of `limit` equal stretches."""
    if n <= limit:
        return list(range(n))
    return [(2 * i + 1) * n // (2 * limit) for i in range(limit)]


def checked_indices(indices: Sequence[int], n: int, source: str) -> list[int]:
    """Frames asked for, ascending. ModelError if one does not exist or is named twice."""
    wrong = sorted({index for index in indices if not 0 <= index < n})
    twice = sorted({index for index in indices if list(indices).count(index) > 1})
    if not indices or wrong or twice:
        problem = f"frame {wrong[0]} does not exist" if wrong else "no frame is named"
        problem = f"frame {twice[0]} is named twice" if twice and not wrong else problem
        expected = f"different indices within 0..{n - 1}"
        raise ModelError(source, problem, expected=expected, action="Change --frames.")
    return sorted(indices)


def scaled_size(size: tuple[int, int], max_side_px: int) -> tuple[int, int]:
    """(width, height) with the longest side at most `max_side_px`; never enlarged."""
    scale = min(1.0, max_side_px / max(size))
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def scaled_down(
    image: UInt8[np.ndarray, "height width 3"], max_side_px: int
) -> UInt8[np.ndarray, "small_height small_width 3"]:
    """Averaged down to `max_side_px`, or the image itself."""
    size = (image.shape[1], image.shape[0])
    small = scaled_size(size, max_side_px)
    return image if small == size else cv2.resize(image, small, interpolation=cv2.INTER_AREA)


def over_black(rgba: UInt8[np.ndarray, "height width 4"]) -> UInt8[np.ndarray, "height width 3"]:
    """Transparent pixels become black: in training black is what lies outside the image."""
    alpha = rgba[..., 3:].astype(np.uint16)
    return ((rgba[..., :3] * alpha + 127) // 255).astype(np.uint8)
