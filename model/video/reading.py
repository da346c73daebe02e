"""read_frames: whatever a user points at, as images."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from difflib import get_close_matches
from functools import partial
from pathlib import Path

from model.errors import ModelError
from model.video.ffmpeg.video_file import read_video
from model.video.ffmpeg.video_listing import listed_video
from model.video.frame_choice import FrameChoice, choose_frames
from model.video.frames import NOTED_CHANGES, TURNED_BY_EXIF, ReadLimits, VideoFrames
from model.video.image_files import read_images
from model.video.image_listing import IMAGE_SUFFIXES, ImageKind, image_kind, listed_folder, listed_image
from model.video.shard_clip import read_clip
from shards.reader import open_shards

__all__ = ["read_frames", "read_informative_frames"]

# Candidate frames within limits, or exactly the frames of some indices.
_Reader = Callable[[ReadLimits, Sequence[int] | None], VideoFrames]


def read_frames(
    source: str | Path, limits: ReadLimits, *, indices: Sequence[int] | None = None
) -> VideoFrames:
    """Candidate frames of a video, a folder of images, one image, or a clip (DATASET#CLIP_ID).

    At most `limits.max_frames`, spread over the source; or exactly the frames `indices` (from 0), when
    given. Raises ModelError for what cannot be used, ShardError for damaged shards.
    """
    return _with_notes(_reader(str(source))(limits, indices))


def read_informative_frames(
    source: str | Path, count: int, candidates: ReadLimits, *, max_side_px: int
) -> tuple[VideoFrames, FrameChoice]:
    """`count` frames chosen among small candidates, read again at up to `max_side_px`, and what decided.

    So a close crop of a 4K video keeps its pixels, while only `count` large images are held. Candidates
    that were not scaled down are not read again.
    """
    reader = _reader(str(source))
    small = reader(candidates, None)
    choice = choose_frames(small, count)
    frames = small.select(choice.positions)
    if any(frame.image_size != frame.source_size for frame in frames.frames):
        limits = ReadLimits(max_frames=count, max_side_px=max_side_px)
        frames = reader(limits, choice.indices.tolist())
    notes = [*small.notes]
    if len(small) < count:
        notes.append(f"{count} frames were asked for, {len(small)} are there")
    notes.extend(_with_notes(frames).notes)
    return replace(frames, notes=tuple(dict.fromkeys(notes))), choice


def _with_notes(frames: VideoFrames) -> VideoFrames:
    """The frames with notes on what was done to them."""
    notes = [change for change in frames.changes if change.startswith(NOTED_CHANGES)]
    turned = sum(TURNED_BY_EXIF in frame.changes for frame in frames.frames)
    if 0 < turned < len(frames):
        notes.append(f"{turned} of {len(frames)} images: {TURNED_BY_EXIF}; the others are as they are stored")
    if frames.n_source_frames == 1:
        notes.append("one frame only: sides that it does not show are guessed")
    return replace(frames, notes=(*frames.notes, *notes))


def _reader(source: str) -> _Reader:
    path = Path(source)
    try:
        if path.is_dir():
            entries = list(path.iterdir())
            _refuse_dataset(source, entries)
            return partial(read_images, listed_folder(path, entries))
        if path.is_file():
            if image_kind(path) is ImageKind.OTHER and path.suffix.lower() not in IMAGE_SUFFIXES:
                return partial(read_video, listed_video(path))
            return partial(read_images, listed_image(path))
        is_there = path.exists()
    except OSError as error:
        raise ModelError(
            error.filename or source,
            f"cannot be read ({(error.strerror or str(error)).lower()})",
            expected="a readable file or folder",
            action="Check its name and permissions.",
        ) from error
    address, mark, clip_id = source.rpartition("#")
    if mark and not is_there:
        return partial(read_clip, address, clip_id)
    known = {file.name for file in path.parent.iterdir()} if path.parent.is_dir() else set()
    close = get_close_matches(path.name, sorted(known - {path.name}), n=1)
    raise ModelError(
        source,
        "neither a file nor a folder" if is_there else "no such file or folder",
        expected="a video, a folder of images, or DATASET#CLIP_ID",
        action=f"Did you mean '{path.parent / close[0]}'?" if close else "Check the path.",
    )


def _refuse_dataset(source: str, entries: Sequence[Path]) -> None:
    """ModelError that names a clip, for a dataset or shard without a clip."""
    if not {"dataset.json", "shard.json"} & {entry.name for entry in entries}:
        return
    clips = [clip for shard in open_shards(source) for clip in shard.record.clip_ids]
    example = f"For example '{source.rstrip('/')}#{clips[0]}'." if clips else "All its motions were skipped."
    raise ModelError(
        source,
        f"this is a dataset with {len(clips)} clips",
        expected="the name of one clip behind a '#'",
        action=example,
    )
