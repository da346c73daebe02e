"""listed_video: which film is in a file, and when each of its frames is shown. Nothing is decoded."""

import re
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import av
from av.stream import Disposition
from av.video.stream import VideoStream

from model.errors import ModelError
from model.video.ffmpeg.video_container import alpha_is_lost, film_streams, opened, reason_of

__all__ = ["ListedVideo", "listed_video"]

# A film is not much shorter than the longest stream of its file; thumbnails are.
_SHORTEST_SHARE = 0.1

# Width over height of a pixel: DV has 0.9 to 1.46, anamorphic lenses 2. Beyond is a mistake in the header.
_PIXEL_RATIOS = (Fraction(1, 4), Fraction(4))

# Longer than any frame is shown: what lacks at the end has been cut off.
_MISSING_END_S = 1.0

# No camera pauses for so long within a film.
_LONGEST_GAP_S = 12 * 3600


@dataclass(frozen=True, kw_only=True)
class ListedVideo:
    """Presentation order of the frames of a file."""

    path: Path
    stream_index: int
    pixel_ratio: Fraction  # width over height of a pixel
    pts: tuple[int, ...]  # in the stream's time base, ascending; or 0, 1, 2, ... without a clock
    keys: tuple[int, ...]  # positions in `pts` where decoding can start
    has_clock: bool
    notes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class _Entry:
    """A packet."""

    pts: int | None
    dts: int | None
    is_key: bool


def listed_video(path: Path) -> ListedVideo:
    """The film of a file and every frame's time, from all the packets of the file.

    Raises ModelError when it is not a video, or holds no frame.
    """
    with opened(path) as container:
        streams = film_streams(container, path)
        entries: dict[int, list[_Entry]] = {stream.index: [] for stream in streams}
        discarded = dict.fromkeys(entries, 0)
        fault = None
        try:
            for packet in container.demux(streams):
                if not packet.size:
                    continue
                if packet.is_discard:  # before the start of an edit list
                    discarded[packet.stream_index] += 1
                else:
                    entry = _Entry(pts=packet.pts, dts=packet.dts, is_key=packet.is_keyframe)
                    entries[packet.stream_index].append(entry)
        except av.FFmpegError as error:
            fault = reason_of(error)
        stream = _film(streams, entries)
        film = entries[stream.index]
        if not film:
            raise ModelError(
                path,
                "the video has no frames (zero length)",
                expected="at least one frame",
                action="Record it again.",
            )
        notes = [
            *_note_of_choice(stream, entries),
            *_notes_of_end(stream, film, discarded[stream.index], fault),
        ]
        if alpha_is_lost(stream):
            notes.append("its transparency is not read: this build of FFmpeg has no libvpx")
        return _in_order(path, stream, film, notes)


def _film(streams: Sequence[VideoStream], entries: Mapping[int, Sequence[_Entry]]) -> VideoStream:
    """The stream marked as default, then the largest, then the longest, of those that are not thumbnails."""
    longest = max(len(entries[stream.index]) for stream in streams)
    films = [stream for stream in streams if len(entries[stream.index]) >= _SHORTEST_SHARE * longest]
    return max(
        films,
        key=lambda stream: (
            bool(stream.disposition & Disposition.default),
            stream.width * stream.height,
            len(entries[stream.index]),
            -stream.index,
        ),
    )


def _in_order(path: Path, stream: VideoStream, film: Sequence[_Entry], notes: list[str]) -> ListedVideo:
    fault = _fault_of_clock(film, stream.time_base)
    pts = sorted(entry.pts for entry in film if entry.pts is not None)
    times = pts if fault is None else list(range(len(film)))
    keys = [entry.pts for entry in film if entry.is_key and entry.pts is not None] if fault is None else []
    if fault is not None:
        notes.append(f"{fault}: frames are taken as they are stored, times are unknown")
    ratio = stream.sample_aspect_ratio or Fraction(1)
    if not _PIXEL_RATIOS[0] <= ratio <= _PIXEL_RATIOS[1]:
        notes.append(
            f"its header gives pixels of ratio {ratio}, which is not believed: they are taken as square"
        )
        ratio = Fraction(1)
    return ListedVideo(
        path=path,
        stream_index=stream.index,
        pixel_ratio=ratio,
        pts=tuple(times),
        keys=tuple(bisect_left(times, time) for time in sorted(keys)),
        has_clock=fault is None,
        notes=tuple(notes),
    )


def _fault_of_clock(film: Sequence[_Entry], time_base: Fraction | None) -> str | None:
    """Why timestamps do not tell the order of the frames, if so."""
    pts = [entry.pts for entry in film if entry.pts is not None]
    if len(pts) < len(film):
        return "the file has no timestamps" if not pts else "some frames have no timestamps"
    if len(set(pts)) < len(pts):
        return "timestamps occur twice"
    # Frames are stored in the order of decoding. Joined recordings start again.
    dts = [entry.dts for entry in film if entry.dts is not None]
    if any(later < earlier for earlier, later in pairwise(dts)):
        return "timestamps go back"
    # Where they go back far, FFmpeg believes in a counter that has run over: after 26 hours in transport streams.
    gap = max((later - earlier for earlier, later in pairwise(sorted(pts))), default=0)
    if time_base is not None and gap * time_base > _LONGEST_GAP_S:
        return "timestamps jump"
    return None


def _note_of_choice(stream: VideoStream, entries: Mapping[int, Sequence[_Entry]]) -> list[str]:
    count = sum(bool(film) for film in entries.values())
    if count < 2:
        return []
    kind = f"{stream.codec_context.name}, {stream.width} x {stream.height}"
    read = f"stream {stream.index} is read ({kind}, {len(entries[stream.index])} frames)"
    return [f"the file holds {count} video streams: {read}"]


def _notes_of_end(
    stream: VideoStream, film: Sequence[_Entry], discarded: int, fault: str | None
) -> list[str]:
    notes = []
    announced = stream.frames
    if stream.container.format.name.startswith("mov"):  # whose index lacks what an edit list cuts off
        announced = min(announced, len(stream.index_entries))
    if announced > len(film) + discarded:
        notes.append(f"the header announces {announced} frames, the file holds {len(film) + discarded}")
    missing_s = _missing_s(stream, film)
    if missing_s > _MISSING_END_S:
        notes.append(f"the file ends {missing_s:.1f} s before the length that its header announces")
    if fault:
        notes.append(f"reading stopped after {len(film)} frames: {fault}")
    return notes


def _missing_s(stream: VideoStream, film: Sequence[_Entry]) -> float:
    """Seconds between the last frame and the end that Matroska's tag DURATION of the track announces."""
    match = re.fullmatch(r"(\d+):(\d+):(\d+(?:\.\d*)?)", stream.metadata.get("DURATION", ""))
    times = [entry.pts for entry in film if entry.pts is not None]
    if match is None or not times or stream.time_base is None:
        return 0.0
    hours, minutes, seconds = map(float, match.groups())
    return 3600 * hours + 60 * minutes + seconds - float(max(times) * stream.time_base)
