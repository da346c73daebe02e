"""FrameConverter: from what a decoder gives to an upright, square-pixel, 8-bit sRGB image."""

from collections.abc import Mapping
from fractions import Fraction
from typing import Any, cast

import cv2
import numpy as np
from av.sidedata.sidedata import Type
from av.video.frame import VideoFrame as DecodedFrame
from av.video.reformatter import ColorPrimaries, ColorTrc, Interpolation, VideoReformatter
from jaxtyping import Int, Shaped, UInt8

from model.video.frames import VideoFrame, over_black, scaled_size

__all__ = ["FrameConverter", "upright"]

_HDR = {ColorTrc.SMPTE2084.value: "PQ", ColorTrc.ARIB_STD_B67.value: "HLG"}
_SCALING = Interpolation.AREA | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT


def upright(
    image: Shaped[np.ndarray, "height width channel"], matrix: Int[np.ndarray, "3 3"]
) -> Shaped[np.ndarray, "new_height new_width channel"]:
    """The image as the display matrix of a container wants it shown: x' = a x + c y, y' = b x + d y.

    Turns are rounded to multiples of 90 degrees; reflections are respected.
    """
    (a, b), (c, d) = matrix[:2, :2].tolist()
    if abs(a) + abs(d) < abs(b) + abs(c):
        image, a, d = image.swapaxes(0, 1), c, b
    return np.ascontiguousarray(image[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1])


class FrameConverter:
    """One per file: swscale builds its colour tables once (seconds for high dynamic range)."""

    def __init__(self, max_side_px: int, pixel_ratio: Fraction) -> None:
        self._max_side_px = max_side_px
        self._pixel_ratio = pixel_ratio  # width over height of a pixel
        self._reformatter = VideoReformatter()
        self._matrix: Int[np.ndarray, "3 3"] | None = None

    def converted(self, frame: DecodedFrame, index: int, time_s: float) -> VideoFrame:
        """The image, scaled down in the same step, and what was done to it."""
        changes: list[str] = []
        width, height = max(1, round(frame.width * self._pixel_ratio)), frame.height
        if self._pixel_ratio != 1:
            changes.append(f"pixels of ratio {self._pixel_ratio} made square")
        size = scaled_size((width, height), self._max_side_px)
        if size != (width, height):
            changes.append(f"scaled down from {width} x {height} to {size[0]} x {size[1]}")
        image = self._rgb(frame, size, changes)
        if self._matrix is None:
            # Once per file: a frame whose side data were looked at is freed late (a reference cycle), and
            # at 4K each is 12 MB.
            self._matrix = _display_matrix(frame)
        (a, b), (c, d) = np.sign(self._matrix[:2, :2]).tolist()
        if (a, b, c, d) != (1, 0, 0, 1):
            changes.append(f"turned as its metadata say (x' = {a} x + {c} y, y' = {b} x + {d} y)")
            image = upright(image, self._matrix)
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

    def _rgb(
        self, frame: DecodedFrame, size: tuple[int, int], changes: list[str]
    ) -> UInt8[np.ndarray, "height width 3"]:
        if frame.format.name.startswith("gray"):
            changes.append("grey copied to three channels")
        if max(component.bits for component in frame.format.components) > 8:
            changes.append("reduced to 8 bits")
        if any(component.is_alpha for component in frame.format.components):
            rgba = self._reformatter.reformat(frame, format="rgba").to_ndarray()
            if rgba[..., 3].min() < 255:
                changes.append("transparency laid over black")
            return cv2.resize(over_black(rgba), size, interpolation=cv2.INTER_AREA)
        target: dict[str, Any] = {}
        if frame.color_trc in _HDR:
            changes.append(f"{_HDR[frame.color_trc]} high dynamic range brought to BT.709")
            target = {"dst_color_trc": ColorTrc.BT709, "dst_color_primaries": ColorPrimaries.BT709}
        scaled = self._reformatter.reformat(
            frame,
            width=size[0],
            height=size[1],
            format="rgb24",
            interpolation=_SCALING,
            threads=1,
            **target,
        )
        return scaled.to_ndarray()


def _display_matrix(frame: DecodedFrame) -> Int[np.ndarray, "3 3"]:
    """16.16 fixed point; the identity for videos without one."""
    side_data = cast(Mapping[Any, Any], frame.side_data)  # PyAV's stub knows one of its keys only
    if Type.DISPLAYMATRIX not in side_data:
        return np.eye(3, dtype=np.int32) << 16
    return np.frombuffer(bytes(side_data[Type.DISPLAYMATRIX]), np.int32).reshape(3, 3)
