"""Frames of a video file through FFmpeg (PyAV).

First the packets are listed without decoding, which gives the exact number and time of every frame,
also of videos with a varying rate. Then only the wanted frames are decoded, from the key frame before
each, and scaled down on the way.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
from av.container import InputContainer
from av.packet import Packet
from av.video.frame import VideoFrame as DecodedFrame
from av.video.stream import VideoStream

from model.errors import ModelError
from model.video.frame_converter import FrameConverter
from model.video.frames import (
    ReadLimits,
    VideoFrame,
    VideoFrames,
    checked_indices,
    even_positions,
)

__all__ = ["read_video"]

# Frames skipped by a seek must be worth emptying the decoder.
_SEEK_FROM_FRAMES = 8


@dataclass(frozen=True, kw_only=True)
class _Packets:
    """Presentation order of the frames of a file."""

    pts: tuple[int, ...]  # in the stream's time base, ascending; or 0, 1, 2, ... without a clock
    keys: tuple[int, ...]  # positions in `pts` where decoding can start
    has_clock: bool
    announced: int  # frames according to the header, 0 if it does not say
    fault: str | None  # why listing ended early


def read_video(path: Path, limits: ReadLimits, indices: Sequence[int] | None) -> VideoFrames:
    """The frames `indices`, or candidates spread over the file; key frames are preferred as candidates.

    Raises ModelError when it is not a video, has no frame, cannot be decoded, or lacks a frame asked for.
    """
    packets = _listed(path)
    n = len(packets.pts)
    wanted = _candidates(packets, limits) if indices is None else checked_indices(indices, n, str(path))
    found = _decoded(path, packets, wanted, limits)
    missing = [position for position in wanted if position not in found]
    if not found or (indices is not None and missing):
        raise ModelError(
            path,
            f"{len(missing)} of {len(wanted)} frames cannot be decoded, the first is frame {missing[0]}",
            expected="an intact file",
            action="Convert it again (ffmpeg -i IN -c:v libx264 OUT.mp4) or choose other frames.",
        )
    return VideoFrames(
        source=str(path),
        kind="video",
        frames=tuple(found[position] for position in sorted(found)),
        n_source_frames=n,
        notes=_notes(packets, len(missing), len(wanted)),
    )


def _opened(path: Path) -> InputContainer:
    """The container, which has a video stream."""
    if path.stat().st_size == 0:
        raise ModelError(
            path, "the file is empty (0 bytes)", expected="a video", action="Copy or record it again."
        )
    try:
        container = av.open(str(path), metadata_errors="replace")  # titles in Latin-1 are common
    except (av.FFmpegError, OSError) as error:
        ended = isinstance(error, av.EOFError)
        reason = "it ends before its first frame: zero length, or cut off" if ended else _reason(error)
        raise _unreadable(path, reason) from error
    kinds = ", ".join(sorted({stream.type for stream in container.streams}))
    if not kinds:
        container.close()
        raise _unreadable(path, "it has no index: zero length, or cut off")
    if not _video_streams(container):
        container.close()
        raise ModelError(
            path, f"it holds {kinds}, but no video", expected="a video", action="Choose another file."
        )
    return container


def _unreadable(path: Path, reason: str) -> ModelError:
    return ModelError(
        path,
        f"not a video that can be read ({reason})",
        expected="a complete mp4, mov, mkv, webm, avi or gif file",
        action="Play it to check it; a download or recording may have been cut off.",
    )


def _video_streams(container: InputContainer) -> list[VideoStream]:
    """Without cover images of audio files."""
    attached = av.stream.Disposition.attached_pic
    return [stream for stream in container.streams.video if not stream.disposition & attached]


def _stream(container: InputContainer, path: Path) -> VideoStream:
    stream = _video_streams(container)[0]
    if stream.codec_context is None:
        raise ModelError(
            path,
            "this build of FFmpeg has no decoder for its codec",
            expected="H.264, HEVC, VP9, AV1, ProRes or another common codec",
            action="Convert it with a program that plays it.",
        )
    stream.thread_type = "AUTO"
    return stream


def _listed(path: Path) -> _Packets:
    """Every packet's time, without decoding."""
    entries: list[tuple[int | None, bool]] = []
    fault = None
    with _opened(path) as container:
        stream = _stream(container, path)
        announced = stream.frames
        try:
            for packet in container.demux(stream):
                if packet.size and not packet.is_discard:  # discarded: before the start of an edit list
                    entries.append((packet.pts, packet.is_keyframe))
        except av.FFmpegError as error:
            fault = _reason(error)
    if not entries:
        raise ModelError(
            path,
            "the video has no frames (zero length)",
            expected="at least one frame",
            action="Record it again.",
        )
    pts = [time for time, _ in entries if time is not None]
    has_clock = len(set(pts)) == len(entries)
    times = sorted(pts) if has_clock else list(range(len(entries)))
    keys = [time for time, key in entries if key and time is not None] if has_clock else []
    return _Packets(
        pts=tuple(times),
        keys=tuple(bisect_left(times, time) for time in sorted(keys)),
        has_clock=has_clock,
        announced=announced,
        fault=fault,
    )


def _candidates(packets: _Packets, limits: ReadLimits) -> list[int]:
    """A frame of each of `max_frames` equal stretches: the key frame nearest to its middle, if it has one.

    A key frame costs one decoding however long the video is, and is the least compressed of its group.
    """
    n, limit = len(packets.pts), limits.max_frames
    middles = even_positions(n, limit)
    if n <= limit:
        return middles
    chosen = []
    for i, middle in enumerate(middles):
        first, last = i * n // limit, (i + 1) * n // limit
        keys = packets.keys[bisect_left(packets.keys, first) : bisect_left(packets.keys, last)]
        chosen.append(min(keys, key=lambda key: (abs(key - middle), key)) if keys else middle)
    return chosen


def _decoded(
    path: Path, packets: _Packets, wanted: Sequence[int], limits: ReadLimits
) -> dict[int, VideoFrame]:
    """The wanted frames that can be decoded, by position."""
    found: dict[int, VideoFrame] = {}
    # A second pass from the start, without seeking, for files whose index points to wrong places.
    for seeking in (True, False) if packets.has_clock else (False,):
        missing = [position for position in wanted if position not in found]
        if missing:
            with _opened(path) as container:
                stream = _stream(container, path)
                converter = FrameConverter(limits.max_side_px, stream.sample_aspect_ratio or Fraction(1))
                for position, frame in _walk(container, stream, packets, missing, seeking=seeking):
                    try:
                        image = converter.converted(frame, position, _time_s(packets, stream, position))
                    except (av.FFmpegError, OSError) as error:
                        raise _inconvertible(path, position, frame, error) from error
                    found[position] = image
    return found


def _inconvertible(path: Path, position: int, frame: DecodedFrame, error: Exception) -> ModelError:
    return ModelError(
        path,
        f"the {frame.format.name} pixels of frame {position} cannot be converted ({_reason(error)})",
        expected="colours that are tagged correctly",
        action="Convert it again (ffmpeg -i IN -pix_fmt yuv420p OUT.mp4).",
    )


def _walk(
    container: InputContainer,
    stream: VideoStream,
    packets: _Packets,
    wanted: Sequence[int],
    *,
    seeking: bool,
) -> Iterator[tuple[int, DecodedFrame]]:
    """(position, frame) of the wanted frames that come out intact, in order."""
    position_of = {time: position for position, time in enumerate(packets.pts)}
    for key, run in _runs(packets, wanted) if seeking else [(None, list(wanted))]:
        if key is not None:
            container.seek(packets.pts[key], stream=stream)
        for ordinal, frame in enumerate(_frames(container, stream)):
            position = ordinal
            if packets.has_clock:
                position = -1 if frame.pts is None else position_of.get(frame.pts, -1)
            if position in run and not frame.is_corrupt:
                yield position, frame
            if position >= run[-1]:
                break


def _runs(packets: _Packets, wanted: Sequence[int]) -> list[tuple[int | None, list[int]]]:
    """Wanted frames in runs that are decoded in one go, each with the key frame to seek to (None: no seek)."""
    runs: list[tuple[int | None, list[int]]] = [(None, [])]
    last = 0
    for position in wanted:
        before = bisect_right(packets.keys, position)
        key = packets.keys[before - 1] if before else 0
        if key > last + _SEEK_FROM_FRAMES:
            runs.append((key, []))
        runs[-1][1].append(position)
        last = position
    return [run for run in runs if run[1]]


def _frames(container: InputContainer, stream: VideoStream) -> Iterator[DecodedFrame]:
    """What decodes; a damaged packet costs its own frame only, a cut file ends. The caller counts what lacks."""
    packets: Iterator[Packet | None] = container.demux(stream)
    for packet in _until_fault(packets):
        try:
            yield from stream.codec_context.decode(packet)
        except av.FFmpegError:
            continue


def _until_fault(packets: Iterator[Packet | None]) -> Iterator[Packet | None]:
    """The packets that can be read, then None, which empties the decoder."""
    try:
        yield from packets
    except av.FFmpegError:
        yield None


def _time_s(packets: _Packets, stream: VideoStream, position: int) -> float:
    if packets.has_clock and stream.time_base is not None:
        return float((packets.pts[position] - packets.pts[0]) * stream.time_base)
    return float("nan")


def _notes(packets: _Packets, missing: int, wanted: int) -> tuple[str, ...]:
    n = len(packets.pts)
    notes = []
    if packets.announced > n:
        notes.append(f"the header announces {packets.announced} frames, the file holds {n}")
    if packets.fault:
        notes.append(f"reading stopped after {n} frames: {packets.fault}")
    if missing:
        notes.append(f"{missing} of {wanted} candidate frames cannot be decoded and are left out")
    if not packets.has_clock:
        notes.append("the file has no timestamps: frames are counted, times are unknown")
    return tuple(notes)


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error).lower()
