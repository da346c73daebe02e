"""Small real videos whose frames say their own number, written by FFmpeg inside the tests."""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace

from model.video.frames import VideoFrames

BITS = 8
QUIET = {"libx265": {"x265-params": "log-level=none"}}


def numbered_frame(number: int, size: tuple[int, int] = (160, 96)) -> np.ndarray:
    """Eight bright or dark columns are the bits of `number`; the top left corner is red, so that it is known."""
    width, height = size
    bits = (number >> np.arange(BITS)) & 1
    columns = np.repeat(40 + 160 * bits, -(-width // BITS))[:width].astype(np.uint8)
    frame = np.repeat(np.repeat(columns[None, :, None], height, axis=0), 3, axis=-1)
    frame[: height // 3] = 100
    frame[: height // 3, : width // 3] = (220, 30, 30)
    return np.ascontiguousarray(frame)


def number_of(image: np.ndarray) -> int:
    """The number of an upright frame at any scale."""
    height, width = image.shape[:2]
    row = image[height * 3 // 4].mean(axis=-1)
    values = row[((np.arange(BITS) + 0.5) * width / BITS).astype(int)]
    return int(((values > 120) << np.arange(BITS)).sum())


def numbers(frames: VideoFrames) -> list[int]:
    return [number_of(image) for image in frames.images]


def corner_is_red(image: np.ndarray) -> bool:
    """Whether the image is the right way up."""
    height, width = image.shape[:2]
    patch = image[: height // 4, : width // 4].reshape(-1, 3).mean(axis=0)
    return bool(patch[0] > 150 and patch[1] < 90 and patch[2] < 90)


def write_video(
    path: Path,
    frames: Iterable[np.ndarray],
    *,
    codec: str = "libx264",
    pix_fmt: str = "yuv420p",
    fps: int = 30,
    group: int = 12,
    turn_deg: int | None = None,
    hflip: bool = False,
    pixel_ratio: Fraction | None = None,
    times: Sequence[int] | None = None,
    hdr_transfer: int | None = None,
    options: dict[str, str] | None = None,
    container_format: str | None = None,
    container_options: dict[str, str] | None = None,
) -> Path:
    """A key frame at least every `group` frames; `times` in 1/fps instead of 0, 1, 2, ..."""
    frames = list(frames)
    grey = frames[0].ndim == 2
    kind = "gray" if grey else {3: "rgb24", 4: "rgba"}[frames[0].shape[2]]
    settings = QUIET.get(codec, {}) | (options or {})
    with av.open(str(path), "w", format=container_format, options=container_options or {}) as container:
        stream = container.add_stream(codec, rate=fps, options=settings)
        assert isinstance(stream, av.VideoStream)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pix_fmt
        stream.codec_context.gop_size = group
        stream.codec_context.thread_count = 1
        if turn_deg is not None:
            stream.set_display_rotation(turn_deg, hflip=hflip)
        if pixel_ratio is not None:
            stream.codec_context.sample_aspect_ratio = pixel_ratio
        if hdr_transfer is not None:
            stream.codec_context.color_trc = hdr_transfer
            stream.codec_context.color_primaries = 9
            stream.codec_context.colorspace = 9
        for number, pixels in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(pixels, format=kind)
            if hdr_transfer is not None:
                frame = frame.reformat(
                    format=pix_fmt, dst_colorspace=Colorspace.BT2020, dst_color_range=ColorRange.MPEG
                )
            frame.pts = number if times is None else times[number]
            frame.time_base = Fraction(1, fps)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def numbered_video(path: Path, n: int, *, size: tuple[int, int] = (160, 96), **settings: object) -> Path:
    return write_video(path, [numbered_frame(i, size) for i in range(n)], **settings)  # type: ignore[arg-type]
