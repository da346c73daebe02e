"""write_mp4: a video that every browser plays."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc
from av.video.stream import VideoStream
from jaxtyping import UInt8

from model.errors import ModelError

__all__ = ["write_mp4"]

_QUALITY = {"crf": "18", "preset": "medium", "movflags": "+faststart"}
_BT709 = 1  # FFmpeg's number of the matrix


def write_mp4(
    frames: Sequence[UInt8[np.ndarray, "height width 3"]] | UInt8[np.ndarray, "frame height width 3"],
    path: Path,
    fps: float,
) -> None:
    """H.264, 4:2:0, BT.709, moov first. Odd sizes get their last row or column twice. The same frames give
    the same bytes. Raises ModelError without frames or for frames of different sizes."""
    shapes = sorted({frame.shape[:2] for frame in frames})
    if len(shapes) != 1:
        found = f"frames of {len(shapes)} sizes" if shapes else "no frames"
        raise ModelError(path, found, expected="frames of one size", action="Scale them first.")
    height, width = (side + side % 2 for side in shapes[0])
    with av.open(str(path), "w", format="mp4", options={"movflags": _QUALITY["movflags"]}) as container:
        options = {name: value for name, value in _QUALITY.items() if name != "movflags"}
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001), options=options)
        assert isinstance(stream, VideoStream)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        context = stream.codec_context
        context.thread_count = 1  # x264's output depends on the number of threads
        context.colorspace = _BT709
        context.color_primaries = ColorPrimaries.BT709.value
        context.color_trc = ColorTrc.BT709.value
        context.color_range = ColorRange.MPEG.value
        for frame in frames:
            padding = ((0, height - frame.shape[0]), (0, width - frame.shape[1]), (0, 0))
            rgb = av.VideoFrame.from_ndarray(np.pad(frame, padding, mode="edge"), format="rgb24")
            yuv = rgb.reformat(
                format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
            )
            container.mux(stream.encode(yuv))
        container.mux(stream.encode())
