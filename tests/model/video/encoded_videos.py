"""Small real videos whose frames say their own number, written by FFmpeg inside the tests."""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from io import BytesIO
from pathlib import Path

import av
import numpy as np
from av.stream import Disposition
from av.video.reformatter import ColorRange, Colorspace
from PIL import Image

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


def stored_for(scene: np.ndarray, orientation: int) -> np.ndarray:
    """The pixels that a camera stores with this EXIF orientation, so that the scene is shown."""
    stored = {
        1: scene,
        2: scene[:, ::-1],
        3: np.rot90(scene, 2),
        4: scene[::-1],
        5: scene.swapaxes(0, 1),
        6: np.rot90(scene, 1),
        7: scene[::-1, ::-1].swapaxes(0, 1),
        8: np.rot90(scene, -1),
    }[orientation]
    return np.ascontiguousarray(stored)


def exif(orientation: int | None) -> Image.Exif:
    data = Image.Exif()
    data[0x010F] = "camera"
    if orientation is not None:
        data[0x0112] = orientation
    return data


def jpeg(pixels: np.ndarray, orientation: int | None) -> bytes:
    """A JPEG with EXIF data."""
    out = BytesIO()
    Image.fromarray(pixels).save(out, "JPEG", exif=exif(orientation), quality=95)
    return out.getvalue()


def write_packets(
    path: Path,
    streams: Sequence[tuple[str, tuple[int, int], Sequence[bytes]]],
    *,
    turn_deg: int | None = None,
    default: int | None = None,
    cover: int | None = None,
) -> Path:
    """Encoded images as they are into streams of (codec, (width, height), images), 25 a second.

    `default`: the stream that players take; `cover`: the one that is a cover image.
    """
    with av.open(str(path), "w") as container:
        for i, (codec, (width, height), _) in enumerate(streams):
            stream = container.add_stream(codec, rate=25)
            assert isinstance(stream, av.VideoStream)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuvj420p"
            if turn_deg is not None:
                stream.set_display_rotation(turn_deg)
            if i == cover:
                stream.disposition = Disposition.attached_pic
            elif default is not None:
                stream.disposition = Disposition.default if i == default else Disposition(0)
            stream.time_base = Fraction(1, 25)
        container.start_encoding()
        for stream, (_, _, images) in zip(container.streams.video, streams, strict=True):
            for number, data in enumerate(images):
                packet = av.Packet(data)
                packet.stream, packet.time_base = stream, Fraction(1, 25)
                packet.pts = packet.dts = number
                packet.is_keyframe = True
                container.mux(packet)
    return path


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
    interlaced: bool = False,
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
            if interlaced:
                frame = _top_field_first(frame.reformat(format=pix_fmt))
            frame.pts = number if times is None else times[number]
            frame.time_base = Fraction(1, fps)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def _top_field_first(frame: av.VideoFrame) -> av.VideoFrame:
    """Only says so; the rows must be woven."""
    graph = av.filter.Graph()
    source = graph.add_buffer(
        width=frame.width, height=frame.height, format=frame.format, time_base=Fraction(1, 25)
    )
    graph.link_nodes(source, graph.add("setfield", mode="tff"), graph.add("buffersink")).configure()
    graph.vpush(frame)
    return graph.vpull()


def numbered_video(path: Path, n: int, *, size: tuple[int, int] = (160, 96), **settings: object) -> Path:
    return write_video(path, [numbered_frame(i, size) for i in range(n)], **settings)  # type: ignore[arg-type]
