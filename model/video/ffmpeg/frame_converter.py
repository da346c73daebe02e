"""FrameConverter: from what a decoder gives to an upright, square-pixel, 8-bit sRGB image."""

from collections.abc import Sequence
from fractions import Fraction

import cv2
import numpy as np
from av.video.frame import VideoFrame as DecodedFrame
from av.video.reformatter import ColorTrc, Interpolation, VideoReformatter
from jaxtyping import Int, UInt8

from model.video.ffmpeg.display_matrix import display_matrix
from model.video.ffmpeg.tone_mapping import Transfer, standard_range
from model.video.frames import TRANSPARENT, VideoFrame, over_black, scaled_size
from model.video.orientation import upright

__all__ = ["FrameConverter"]

_HDR: dict[int, Transfer] = {ColorTrc.SMPTE2084.value: "PQ", ColorTrc.ARIB_STD_B67.value: "HLG"}
_SCALING = Interpolation.AREA | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT

# (alpha, high dynamic range)
_FORMATS = {
    (False, False): "rgb24",
    (False, True): "rgb48le",
    (True, False): "rgba",
    (True, True): "rgba64le",
}


class FrameConverter:
    """One per file: swscale builds its tables once."""

    def __init__(self, max_side_px: int, pixel_ratio: Fraction) -> None:
        self._max_side_px = max_side_px
        self._pixel_ratio = pixel_ratio  # width over height of a pixel
        self._reformatter = VideoReformatter()
        self._rotation_deg: int | None = None
        self._matrix: Int[np.ndarray, "2 2"] = np.eye(2, dtype=np.int32)

    def converted(
        self, frame: DecodedFrame, index: int, time_s: float, changes_before: Sequence[str]
    ) -> VideoFrame:
        """The image, scaled down in the same step, and what was done to it."""
        changes = [*changes_before]
        width, height = max(1, round(frame.width * self._pixel_ratio)), frame.height
        if self._pixel_ratio != 1:
            changes.append(f"pixels of ratio {self._pixel_ratio} made square")
        size = scaled_size((width, height), self._max_side_px)
        if size != (width, height):
            changes.append(f"scaled down from {width} x {height} to {size[0]} x {size[1]}")
        image = self._rgb(frame, size, changes)
        matrix = self._display_matrix(frame)
        (a, b), (c, d) = np.sign(matrix).tolist()
        if (a, b, c, d) != (1, 0, 0, 1):
            changes.append(f"turned as its metadata say (x' = {a} x + {c} y, y' = {b} x + {d} y)")
            image = upright(image, matrix)
            if image.shape[:2] != size[::-1]:
                width, height = height, width
        return VideoFrame(
            image=image,
            index=index,
            time_s=time_s,
            name=f"frame {index}",
            source_size=(width, height),
            changes=tuple(changes),
        )

    def _display_matrix(self, frame: DecodedFrame) -> Int[np.ndarray, "2 2"]:
        """Looked up when the rotation changes: a frame whose side data were looked at is freed late (a
        reference cycle), and at 4K each is 12 MB."""
        if frame.rotation != self._rotation_deg:
            self._rotation_deg, self._matrix = frame.rotation, display_matrix(frame)
        return self._matrix

    def _rgb(
        self, frame: DecodedFrame, size: tuple[int, int], changes: list[str]
    ) -> UInt8[np.ndarray, "height width 3"]:
        if frame.format.name.startswith("gray"):
            changes.append("grey copied to three channels")
        if max(component.bits for component in frame.format.components) > 8:
            changes.append("reduced to 8 bits")
        transfer = _HDR.get(frame.color_trc)
        if transfer is not None:
            changes.append(f"{transfer} high dynamic range brought to BT.709")
        has_alpha = any(component.is_alpha for component in frame.format.components)
        # Transparent pixels must be black before they are averaged.
        width, height = (frame.width, frame.height) if has_alpha else size
        pixels: np.ndarray = self._reformatter.reformat(
            frame,
            width=width,
            height=height,
            format=_FORMATS[has_alpha, transfer is not None],
            interpolation=_SCALING,
            threads=1,
        ).to_ndarray()
        rgb = pixels[..., :3] if transfer is None else standard_range(pixels[..., :3], transfer)
        if not has_alpha:
            return rgb
        alpha = pixels[..., 3] if transfer is None else (pixels[..., 3] // 257).astype(np.uint8)
        if alpha.min() < 255:
            changes.append(TRANSPARENT)
        return cv2.resize(over_black(np.dstack([rgb, alpha])), size, interpolation=cv2.INTER_AREA)
