"""read_frames: whatever a user points at, as images."""

from collections.abc import Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path

from model.errors import ModelError
from model.video.frame_choice import FrameChoice, choose_frames
from model.video.frames import ReadLimits, VideoFrames
from model.video.image_files import IMAGE_SUFFIXES, read_images
from model.video.shard_clip import read_clip
from model.video.video_file import read_video
from shards.reader import open_shards

__all__ = ["read_frames", "read_informative_frames"]


def read_frames(
    source: str | Path, limits: ReadLimits, *, indices: Sequence[int] | None = None
) -> VideoFrames:
    """Candidate frames of a video, a folder of images, one image, or a clip (DATASET#CLIP_ID).

    At most `limits.max_frames`, spread over the source; or exactly the frames `indices` (from 0), when
    given. Raises ModelError for what cannot be used, ShardError for damaged shards.
    """
    frames = _read(str(source), limits, indices)
    if frames.n_source_frames > 1:
        return frames
    note = "one frame only: sides that it does not show are guessed"
    return replace(frames, notes=(*frames.notes, note))


def read_informative_frames(
    source: str | Path, count: int, candidates: ReadLimits, *, max_side_px: int
) -> tuple[VideoFrames, FrameChoice]:
    """`count` frames chosen among small candidates, read again at up to `max_side_px`, and what decided.

    So a close crop of a 4K video keeps its pixels, while only `count` large images are held.
    """
    small = read_frames(source, candidates)
    choice = choose_frames(small, count)
    limits = ReadLimits(max_frames=count, max_side_px=max_side_px)
    frames = read_frames(source, limits, indices=choice.indices.tolist())
    notes = [*small.notes]
    if len(small) < count:
        notes.append(f"{count} frames were asked for, {len(small)} are there")
    return replace(frames, notes=tuple(dict.fromkeys((*notes, *frames.notes)))), choice


def _read(source: str, limits: ReadLimits, indices: Sequence[int] | None) -> VideoFrames:
    path = Path(source)
    if path.is_dir():
        files = [file for file in path.iterdir() if file.is_file() and not file.name.startswith(".")]
        _refuse_dataset(source, files)
        return read_images(path, files, limits, indices)
    if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file():
        return read_images(path, [path], limits, indices)
    if path.is_file():
        return read_video(path, limits, indices)
    address, mark, clip_id = source.rpartition("#")
    if mark:
        return read_clip(address, clip_id, limits, indices)
    known = [file.name for file in path.parent.iterdir()] if path.parent.is_dir() else []
    close = get_close_matches(path.name, known, n=1)
    raise ModelError(
        source,
        "no such file or folder",
        expected="a video, a folder of images, or DATASET#CLIP_ID",
        action=f"Did you mean '{path.parent / close[0]}'?" if close else "Check the path.",
    )


def _refuse_dataset(source: str, files: Sequence[Path]) -> None:
    """ModelError that names a clip, for a dataset or shard without a clip."""
    if not {"dataset.json", "shard.json"} & {file.name for file in files}:
        return
    clips = [clip for shard in open_shards(source) for clip in shard.record.clip_ids]
    example = f"For example '{source.rstrip('/')}#{clips[0]}'." if clips else "All its motions were skipped."
    raise ModelError(
        source,
        f"this is a dataset with {len(clips)} clips",
        expected="the name of one clip behind a '#'",
        action=example,
    )
