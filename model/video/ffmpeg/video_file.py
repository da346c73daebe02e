"""Frames of a video file through FFmpeg (PyAV).

Only the wanted frames are decoded, from the key frame before each, and scaled down on the way.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence

import av
from av.container import InputContainer
from av.packet import Packet
from av.video.codeccontext import VideoCodecContext
from av.video.frame import VideoFrame as DecodedFrame
from av.video.stream import VideoStream

from model.errors import ModelError
from model.video.ffmpeg.deinterlacing import deinterlaced
from model.video.ffmpeg.frame_converter import FrameConverter
from model.video.ffmpeg.video_container import decoder_of, opened, reason_of
from model.video.ffmpeg.video_listing import ListedVideo
from model.video.frames import (
    DEINTERLACED,
    ReadLimits,
    VideoFrame,
    VideoFrames,
    checked_indices,
    even_positions,
)

__all__ = ["read_video"]

# Frames skipped by a seek must be worth emptying the decoder.
_SEEK_FROM_FRAMES = 8


def read_video(video: ListedVideo, limits: ReadLimits, indices: Sequence[int] | None) -> VideoFrames:
    """The frames `indices`, or candidates spread over the file; key frames are preferred as candidates.

    Raises ModelError when nothing can be decoded, or a frame that was asked for cannot.
    """
    n = len(video.pts)
    wanted = _candidates(video, limits) if indices is None else checked_indices(indices, n, str(video.path))
    found = _decoded(video, wanted, limits)
    missing = [position for position in wanted if position not in found]
    if not found or (indices is not None and missing):
        raise ModelError(
            video.path,
            f"{len(missing)} of {len(wanted)} frames cannot be decoded, the first is frame {missing[0]}",
            expected="an intact file",
            action="Convert it again (ffmpeg -i IN -c:v libx264 OUT.mp4) or choose other frames.",
        )
    notes = [*video.notes]
    if missing:
        notes.append(f"{len(missing)} of {len(wanted)} candidate frames cannot be decoded and are left out")
    return VideoFrames(
        source=str(video.path),
        kind="video",
        frames=tuple(found[position] for position in sorted(found)),
        n_source_frames=n,
        notes=tuple(notes),
    )


def _candidates(video: ListedVideo, limits: ReadLimits) -> list[int]:
    """A frame of each of `max_frames` equal stretches: the key frame nearest to its middle, if it has one.

    A key frame costs one decoding however long the video is, and is the least compressed of its group.
    """
    n, limit = len(video.pts), limits.max_frames
    middles = even_positions(n, limit)
    if n <= limit:
        return middles
    chosen = []
    for i, middle in enumerate(middles):
        first, last = i * n // limit, (i + 1) * n // limit
        keys = video.keys[bisect_left(video.keys, first) : bisect_left(video.keys, last)]
        chosen.append(min(keys, key=lambda key: (abs(key - middle), key)) if keys else middle)
    return chosen


def _decoded(video: ListedVideo, wanted: Sequence[int], limits: ReadLimits) -> dict[int, VideoFrame]:
    """The wanted frames that can be decoded, by position."""
    found: dict[int, VideoFrame] = {}
    # A second pass from the start, without seeking, for files whose index points to wrong places.
    for seeking in (True, False) if video.has_clock else (False,):
        missing = [position for position in wanted if position not in found]
        if missing:
            with opened(video.path) as container:
                stream = container.streams[video.stream_index]
                assert isinstance(stream, VideoStream)
                converter = FrameConverter(limits.max_side_px, video.pixel_ratio)
                for position, frame, was_interlaced in _walk(
                    container, stream, video, missing, seeking=seeking
                ):
                    time_s = _time_s(video, stream, position)
                    changes = [DEINTERLACED] if was_interlaced else []
                    try:
                        found[position] = converter.converted(frame, position, time_s, changes)
                    except (av.FFmpegError, OSError) as error:
                        raise _inconvertible(video, position, frame, error) from error
    return found


def _inconvertible(video: ListedVideo, position: int, frame: DecodedFrame, error: Exception) -> ModelError:
    return ModelError(
        video.path,
        f"the {frame.format.name} pixels of frame {position} cannot be converted ({reason_of(error)})",
        expected="colours that are tagged correctly",
        action="Convert it again (ffmpeg -i IN -pix_fmt yuv420p OUT.mp4).",
    )


def _walk(
    container: InputContainer,
    stream: VideoStream,
    video: ListedVideo,
    wanted: Sequence[int],
    *,
    seeking: bool,
) -> Iterator[tuple[int, DecodedFrame, bool]]:
    """(position, frame, whether it was interlaced) of the wanted frames that come out intact, in order."""
    position_of = {time: position for position, time in enumerate(video.pts)}
    decoder = decoder_of(stream)
    for key, run in _runs(video, wanted) if seeking else [(None, list(wanted))]:
        if key is not None:
            container.seek(video.pts[key], stream=stream)
            decoder.flush_buffers()
        frames = deinterlaced(_frames(container, stream, decoder))
        for ordinal, (frame, was_interlaced) in enumerate(frames):
            position = ordinal
            if video.has_clock:
                position = -1 if frame.pts is None else position_of.get(frame.pts, -1)
            if position in run and not frame.is_corrupt:
                yield position, frame, was_interlaced
            if position >= run[-1]:
                break


def _runs(video: ListedVideo, wanted: Sequence[int]) -> list[tuple[int | None, list[int]]]:
    """Wanted frames in runs that are decoded in one go, each with the key frame to seek to (None: no seek)."""
    runs: list[tuple[int | None, list[int]]] = [(None, [])]
    last = 0
    for position in wanted:
        before = bisect_right(video.keys, position)
        key = video.keys[before - 1] if before else 0
        if key > last + _SEEK_FROM_FRAMES:
            runs.append((key, []))
        runs[-1][1].append(position)
        last = position
    return [run for run in runs if run[1]]


def _frames(
    container: InputContainer, stream: VideoStream, decoder: VideoCodecContext
) -> Iterator[DecodedFrame]:
    """What decodes; a damaged packet costs its own frame only, a cut file ends. The caller counts what lacks."""
    packets: Iterator[Packet | None] = container.demux(stream)
    for packet in _until_fault(packets):
        try:
            yield from decoder.decode(packet)
        except av.FFmpegError:
            continue


def _until_fault(packets: Iterator[Packet | None]) -> Iterator[Packet | None]:
    """The packets that can be read, then None, which empties the decoder."""
    try:
        yield from packets
    except av.FFmpegError:
        yield None


def _time_s(video: ListedVideo, stream: VideoStream, position: int) -> float:
    if video.has_clock and stream.time_base is not None:
        return float((video.pts[position] - video.pts[0]) * stream.time_base)
    return float("nan")
