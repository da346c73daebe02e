"""Does a finished shard hold what it says, and do its numbers agree with each other?

`verify_dataset` reads everything once: file hashes, rows, every image, and the invariants that tie
masks, depth, boxes, joints, poses, splits and object samples together (`invariants.py`); over all
shards, that no object is in two splits. It collects findings instead of stopping at the first.
"""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from shards.errors import MissingColumnError, ShardError, SplitError
from shards.invariants import clip_problems, frame_problems, object_problems
from shards.reader import Frames, Shard, open_shards
from shards.schema import ROW_TYPES, ClipRow
from shards.splits import ObjectSplits, SplitRule

__all__ = ["Finding", "ShardReport", "verify_dataset", "verify_shard"]

Progress = Callable[[int, int, int], None]  # number of the shard, its clips done, its clips in all
_BLOCK = 1 << 22


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that is wrong, and where."""

    where: str
    problem: str

    def __str__(self) -> str:
        return f"{self.where}: {self.problem}"


@dataclass(frozen=True, kw_only=True)
class ShardReport:
    """What was looked at and what was found."""

    path: str
    n_objects: int
    n_clips: int
    n_frames: int
    n_bytes: int
    skipped: tuple[str, ...]  # "motion 12: reason"
    findings: tuple[Finding, ...]

    @property
    def ok(self) -> bool:
        return not self.findings


def verify_dataset(url: str | Path, *, progress: Progress | None = None) -> Iterator[ShardReport]:
    """The report of every finished shard of a dataset, in order, or of the one shard that `url` is.

    Splits are held against the rule of the dataset that a shard lies in. ShardError when nothing can be opened.
    """
    splits = ObjectSplits()
    for shard in open_shards(url):
        of_shard = partial(progress, shard.record.shard) if progress else None
        report = verify_shard(shard, split_rule=shard.read_split_rule(), progress=of_shard)
        yield replace(report, findings=(*report.findings, *_split_findings(shard, splits)))


def verify_shard(
    shard: Shard, *, split_rule: SplitRule | None, progress: Callable[[int, int], None] | None = None
) -> ShardReport:
    """Check everything about one shard; `split_rule` None: splits are not held against a rule.

    `progress` gets clips done and clips in all.
    """
    findings = list(_file_findings(shard))
    n_frames = 0
    if not findings:  # damaged files are reported once, not again by every row
        try:
            findings += _object_findings(shard)
            for clip_findings, clip_frames in _clips_findings(shard, split_rule, progress):
                findings += clip_findings
                n_frames += clip_frames
        except ShardError as error:
            findings.append(Finding(where=shard.path, problem=str(error)))
        rows = shard.record.files["frames.parquet"].rows
        if n_frames != rows and not findings:
            findings.append(_finding(shard, f"expected {rows} frames, found {n_frames}"))
    return ShardReport(
        path=shard.path,
        n_objects=shard.record.files["objects.parquet"].rows
        if "objects.parquet" in shard.record.files
        else 0,
        n_clips=len(shard.record.clip_ids),
        n_frames=n_frames,
        n_bytes=sum(record.n_bytes for record in shard.record.files.values()),
        skipped=tuple(f"motion {m.motion_index}: {m.skip_reason}" for m in shard.record.skipped),
        findings=tuple(findings),
    )


def _finding(shard: Shard, problem: str, *where: str) -> Finding:
    return Finding(where=", ".join((shard.path, *where)), problem=problem)


def _file_findings(shard: Shard) -> Iterator[Finding]:
    """Whole-file hashes and the presence of every column of the schema."""
    for name, row_type in ROW_TYPES.items():
        file_name = f"{name}.parquet"
        if file_name not in shard.record.files:
            yield _finding(shard, "not listed in shard.json", file_name)
            continue
        try:
            problem = _hash_problem(shard, file_name) or _schema_problem(shard, name, row_type)
        except (ShardError, OSError) as error:
            problem = str(error)
        if problem:
            yield _finding(shard, problem, file_name)


def _hash_problem(shard: Shard, file_name: str) -> str:
    record, digest, n_bytes = shard.record.files[file_name], hashlib.sha256(), 0
    with shard.fs.open(f"{shard.path}/{file_name}", "rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
            n_bytes += len(block)
    if n_bytes != record.n_bytes:
        return f"expected {record.n_bytes} bytes, found {n_bytes}"
    return "" if digest.hexdigest() == record.sha256 else "the content does not match its SHA-256"


def _schema_problem(shard: Shard, name: str, row_type: type) -> str:
    source = shard.source(name)
    rows = shard.record.files[f"{name}.parquet"].rows
    if source.metadata.num_rows != rows:
        return f"expected {rows} rows, found {source.metadata.num_rows}"
    try:
        source.check_columns(row_type)
    except MissingColumnError as error:
        return str(error)
    return ""


def _object_findings(shard: Shard) -> list[Finding]:
    findings = []
    for row in shard.objects():
        findings += [_finding(shard, problem, f"object {row.object_uid}") for problem in object_problems(row)]
    return findings


def _clips_findings(
    shard: Shard, split_rule: SplitRule | None, progress: Callable[[int, int], None] | None
) -> Iterator[tuple[list[Finding], int]]:
    """Findings and number of frames of each clip."""
    clips = shard.clips()
    uids = set(shard.read_objects(["object_uid"])["object_uid"])
    if [clip.clip_id for clip in clips] != list(shard.record.clip_ids):
        yield [_finding(shard, "clips.parquet and shard.json list different clips")], 0
    for done, clip in enumerate(clips):
        if progress:
            progress(done, len(clips))
        frames = shard.read_frames(clip.clip_id)
        problems = clip_problems(clip, frames, split_rule)
        if clip.object_uid not in uids:
            problems.append(f"object {clip.object_uid} is not in objects.parquet")
        problems += _frame_problems(frames, clip)
        yield [_finding(shard, problem, f"clip {clip.clip_id}") for problem in problems], len(frames)
    if progress:
        progress(len(clips), len(clips))


def _split_findings(shard: Shard, splits: ObjectSplits) -> Iterator[Finding]:
    """Objects that an earlier clip or shard has in another split; once each."""
    try:
        clips = shard.read_clips(["object_uid", "split"])
    except ShardError:  # damage, which is reported already
        return
    for uid, split in dict.fromkeys(zip(clips["object_uid"], clips["split"])):
        try:
            splits.add(uid, split, where=shard.path)
        except SplitError as error:
            yield _finding(shard, error.problem)


def _frame_problems(frames: Frames, clip: ClipRow) -> list[str]:
    """Each problem once per clip, with the frames that have it."""
    seen: dict[str, list[int]] = {}
    for index in range(len(frames)):
        try:
            problems = frame_problems(frames.frame(index), clip)
        except ShardError as error:
            problems = [str(error.__cause__ or error)]  # the cause, because it does not repeat the frame
        for problem in problems:
            seen.setdefault(problem, []).append(index)
    return [
        f"{problem} (frames {', '.join(map(str, indices[:8]))}{' ...' if len(indices) > 8 else ''})"
        for problem, indices in seen.items()
    ]
