"""Write a shard so that it is complete and verified, or absent, whenever the process dies.

staging/shard-00000/motion-000012/    one finished motion: three Parquet fragments and,
                                      written last, motion.json with their SHA-256
shards/.shard-00000.partial/          being assembled; ignored by readers, removed on a new start
shards/shard-00000/                   renamed into place; exists for readers once shard.json,
                                      written last, is there. Then staging is removed.
"""

import itertools
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from shards.card import write_card
from shards.columns import table_from_rows
from shards.errors import (
    IncompleteShardError,
    RowError,
    ShardError,
    storage_error,
)
from shards.schema import ROW_TYPES, SCHEMA_VERSION, ClipRow, FrameRow, ObjectRow
from shards.storage.parquet import ParquetSource, file_metadata, file_record, local_source, parquet_writer
from shards.storage.records import (
    DatasetRecord,
    MotionRecord,
    Provenance,
    ShardRecord,
    parse_record,
    write_record,
)
from shards.storage.whole_file import fsync_dir, fsync_file

__all__ = [
    "begin_dataset",
    "commit_shard",
    "is_motion_staged",
    "is_shard_committed",
    "motion_dir",
    "shard_dir",
    "stage_motion",
    "stage_skipped_motion",
    "staging_dir",
]


def shard_dir(dataset_dir: Path, shard: int) -> Path:
    """Where a finished shard is."""
    return dataset_dir / "shards" / f"shard-{shard:05d}"


def staging_dir(dataset_dir: Path, shard: int) -> Path:
    """Where the finished motions of a shard wait for it to be committed."""
    return dataset_dir / "staging" / f"shard-{shard:05d}"


def motion_dir(dataset_dir: Path, shard: int, motion_index: int) -> Path:
    """One of those motions."""
    return staging_dir(dataset_dir, shard) / f"motion-{motion_index:06d}"


def begin_dataset(dataset_dir: Path, record: DatasetRecord) -> None:
    """Write dataset.json and README.md, or check that the record there was made from the same configuration."""
    path = dataset_dir / "dataset.json"
    if path.exists():
        present = parse_record(path.read_bytes(), DatasetRecord, where=str(path))
        fix = "choose another output folder"
        _check_same_config(present.provenance, record.provenance, where=path, fix=fix)
    else:
        _make_dir(dataset_dir)
        write_record(path, record)
    write_card(dataset_dir, record)


def is_shard_committed(dataset_dir: Path, shard: int) -> bool:
    """Whether the shard is complete; its shard.json is the proof."""
    return (shard_dir(dataset_dir, shard) / "shard.json").exists()


def is_motion_staged(dataset_dir: Path, shard: int, motion_index: int, provenance: Provenance) -> bool:
    """Whether this motion is finished (or finally skipped) and need not be made again.

    Raises ShardError when it was made from another configuration, or is damaged.
    """
    path = motion_dir(dataset_dir, shard, motion_index) / "motion.json"
    if not path.exists():
        return False
    record = _read_motion(path)
    fix = f"delete {path.parent} to make the motion again, or choose another output folder"
    _check_same_config(record.provenance, provenance, where=path, fix=fix)
    return True


def stage_motion(
    dataset_dir: Path,
    shard: int,
    motion_index: int,
    *,
    object_row: ObjectRow,
    clips: Sequence[ClipRow],
    frames: Iterable[FrameRow],
    timings_s: Mapping[str, float],
    provenance: Provenance,
) -> MotionRecord:
    """Keep one finished motion durably. `frames` runs clip by clip, frame by frame.

    Only one clip's frames are in memory at a time. Raises RowError when a value does not fit
    the schema, DiskFullError or StorageError; nothing of the motion is then left behind.
    """
    folder = motion_dir(dataset_dir, shard, motion_index)
    with _whole_or_nothing(folder, doing=f"storing motion {motion_index}"):
        _write_fragment(folder / "objects.parquet", ObjectRow, [[object_row]])
        _write_fragment(folder / "clips.parquet", ClipRow, [_checked_clips(clips, object_row, motion_index)])
        _write_fragment(folder / "frames.parquet", FrameRow, _frames_by_clip(clips, frames))
        record = MotionRecord(
            motion_index=motion_index,
            schema_version=SCHEMA_VERSION,
            provenance=provenance,
            skip_reason=None,
            clip_ids=tuple(clip.clip_id for clip in clips),
            timings_s=dict(timings_s),
            files={f"{name}.parquet": file_record(folder / f"{name}.parquet") for name in ROW_TYPES},
        )
        _finish_motion(folder, record)
    return record


def stage_skipped_motion(
    dataset_dir: Path,
    shard: int,
    motion_index: int,
    *,
    reason: str,
    timings_s: Mapping[str, float],
    provenance: Provenance,
) -> MotionRecord:
    """Record that a planned motion cannot be made, and why; it is listed in shard.json."""
    folder = motion_dir(dataset_dir, shard, motion_index)
    record = MotionRecord(
        motion_index=motion_index,
        schema_version=SCHEMA_VERSION,
        provenance=provenance,
        skip_reason=reason,
        clip_ids=(),
        timings_s=dict(timings_s),
        files={},
    )
    with _whole_or_nothing(folder, doing=f"recording skipped motion {motion_index}"):
        _finish_motion(folder, record)
    return record


def commit_shard(
    dataset_dir: Path, shard: int, *, motion_indices: Sequence[int], provenance: Provenance
) -> ShardRecord:
    """Assemble the staged motions, in the order given, into a finished shard. Safe to call again.

    Raises IncompleteShardError when a motion is not staged, CorruptShardError when a staged file
    is not what was written, DiskFullError or StorageError; staged motions are kept in every case.
    """
    final = shard_dir(dataset_dir, shard)
    staging = staging_dir(dataset_dir, shard)
    if is_shard_committed(dataset_dir, shard):
        record = parse_record(
            (final / "shard.json").read_bytes(), ShardRecord, where=str(final / "shard.json")
        )
        shutil.rmtree(staging, ignore_errors=True)
        return record
    motions = _staged_motions(dataset_dir, shard, motion_indices, provenance)
    partial = final.with_name(f".{final.name}.partial")
    needed = sum(file.n_bytes for motion in motions for file in motion.files.values())
    with _whole_or_nothing(partial, doing=f"committing shard {shard}", needed_bytes=needed):
        _assemble(staging, motions, partial, provenance)
        files = {f"{name}.parquet": file_record(partial / f"{name}.parquet") for name in ROW_TYPES}
        record = ShardRecord(
            shard=shard, schema_version=SCHEMA_VERSION, provenance=provenance, files=files, motions=motions
        )
        _verify_assembled(partial, record)
        if final.exists():  # killed after the rename and before shard.json
            shutil.rmtree(final)
        partial.rename(final)
        fsync_dir(final.parent)
        fsync_dir(dataset_dir)
        write_record(final / "shard.json", record)
    shutil.rmtree(staging, ignore_errors=True)
    return record


def _staged_motions(
    dataset_dir: Path, shard: int, motion_indices: Sequence[int], provenance: Provenance
) -> tuple[MotionRecord, ...]:
    missing = [i for i in motion_indices if not is_motion_staged(dataset_dir, shard, i, provenance)]
    if missing:
        raise IncompleteShardError(
            f"{len(missing)} of {len(motion_indices)} motions are not finished",
            where=str(shard_dir(dataset_dir, shard)),
            found=f"no motion {', '.join(map(str, missing[:10]))}{' ...' if len(missing) > 10 else ''}",
            fix="render the shard again: finished motions are kept",
        )
    motions = tuple(_read_motion(motion_dir(dataset_dir, shard, i) / "motion.json") for i in motion_indices)
    clip_ids = [clip_id for motion in motions for clip_id in motion.clip_ids]
    if len(set(clip_ids)) != len(clip_ids):
        twice = sorted({c for c in clip_ids if clip_ids.count(c) > 1})
        raise RowError("clip ids are not unique", where=f"shard {shard}", column="clip_id", found=twice)
    return motions


def _assemble(staging: Path, motions: Sequence[MotionRecord], partial: Path, provenance: Provenance) -> None:
    """Copy fragments row group by row group; only the few clip rows are gathered into one group."""
    metadata = file_metadata(
        generator_commit=provenance.generator_commit, config_sha256=provenance.config_sha256
    )
    for name, row_type in ROW_TYPES.items():
        groups = _fragments(staging, motions, f"{name}.parquet")
        if row_type is ClipRow:
            clips = list(groups)
            groups = iter([pa.concat_tables(clips)] if clips else [])
        with parquet_writer(partial / f"{name}.parquet", row_type, metadata) as writer:
            for table in groups:
                _write_row_group(writer, table)
        fsync_file(partial / f"{name}.parquet")
    fsync_dir(partial)


def _fragments(staging: Path, motions: Sequence[MotionRecord], file_name: str) -> Iterator[pa.Table]:
    """Row groups of one file of all motions, in order; an object only the first time it comes."""
    seen: dict[str, str] = {}
    for motion in motions:
        if motion.skip_reason is not None:
            continue
        fragment = staging / f"motion-{motion.motion_index:06d}" / file_name
        if file_name == "objects.parquet" and _is_repeated_object(fragment, motion, seen):
            continue
        yield from _source(fragment, motion).row_groups()


def _write_row_group(writer: pq.ParquetWriter, table: pa.Table) -> None:
    writer.write_table(table.replace_schema_metadata(), row_group_size=max(1, table.num_rows))


def _is_repeated_object(fragment: Path, motion: MotionRecord, seen: dict[str, str]) -> bool:
    """Whether an earlier motion of the shard brought the same object; equal rows are equal files."""
    table = _source(fragment, motion).read_row_group(0, ["object_uid"])
    uid = table["object_uid"][0].as_py()
    digest = motion.files["objects.parquet"].sha256
    repeated = uid in seen
    if seen.setdefault(uid, digest) != digest:
        raise RowError(
            "two motions describe the same object differently",
            where=str(fragment),
            column="object_uid",
            found=uid,
            fix="delete the staged motions of this object and render them again with one version of it",
        )
    return repeated


def _source(fragment: Path, motion: MotionRecord) -> ParquetSource:
    if not fragment.exists():
        fix = f"delete {fragment.parent} to make the motion again"
        raise IncompleteShardError("a staged file is gone", where=str(fragment), fix=fix)
    return local_source(fragment, motion.files[fragment.name])


def _verify_assembled(folder: Path, record: ShardRecord) -> None:
    """Read everything back from the disk, all checksums on, before the shard may exist."""
    for name in ROW_TYPES:
        source = local_source(folder / f"{name}.parquet", record.files[f"{name}.parquet"])
        for group, table in enumerate(source.row_groups()):
            if name == "frames" and table["clip_id"].unique().to_pylist() != [record.clip_ids[group]]:
                raise ShardError("row group of another clip", where=source.path, row=f"group {group}")
        if name == "frames" and source.num_row_groups != len(record.clip_ids):
            raise ShardError("row groups and clips differ in number", where=source.path)


def _write_fragment(path: Path, row_type: type, groups: Iterable[Sequence[object]]) -> None:
    with parquet_writer(path, row_type, file_metadata()) as writer:
        for rows in groups:
            _write_row_group(writer, table_from_rows(rows, row_type, where=path.name))
    fsync_file(path)


def _checked_clips(clips: Sequence[ClipRow], object_row: ObjectRow, motion_index: int) -> Sequence[ClipRow]:
    for row, clip in enumerate(clips):
        for column, expected, found in (
            ("motion_index", motion_index, clip.motion_index),
            ("object_uid", object_row.object_uid, clip.object_uid),
        ):
            if expected != found:
                raise RowError(
                    "does not match the motion",
                    where="clips",
                    row=row,
                    column=column,
                    expected=expected,
                    found=found,
                )
    return clips


def _frames_by_clip(clips: Sequence[ClipRow], frames: Iterable[FrameRow]) -> Iterator[list[FrameRow]]:
    groups = itertools.groupby(frames, key=lambda frame: frame.clip_id)
    for clip in clips:
        clip_id, group = next(groups, (None, iter(())))
        if clip_id != clip.clip_id:
            raise RowError(
                "frames out of order", where="frames", column="clip_id", expected=clip.clip_id, found=clip_id
            )
        rows = list(group)
        indices = [frame.frame_index for frame in rows]
        if indices != list(range(clip.n_frames)):
            raise RowError(
                f"frames of clip {clip_id} are not 0..n_frames-1",
                where="frames",
                column="frame_index",
                expected=f"{clip.n_frames} frames",
                found=indices if len(indices) < 20 else f"{len(indices)} frames",
            )
        yield rows
    for clip_id, _ in groups:
        raise RowError("frames of an unknown clip", where="frames", column="clip_id", found=clip_id)


def _read_motion(path: Path) -> MotionRecord:
    return parse_record(path.read_bytes(), MotionRecord, where=str(path))


def _check_same_config(present: Provenance, wanted: Provenance, *, where: Path, fix: str) -> None:
    if present.config_sha256 != wanted.config_sha256:
        raise ShardError(
            "made from another configuration",
            where=str(where),
            expected=f"config {wanted.config_sha256[:12]}",
            found=present.config_sha256[:12],
            fix=fix,
        )


@contextmanager
def _whole_or_nothing(folder: Path, *, doing: str, needed_bytes: int | None = None) -> Iterator[None]:
    """Fill an empty `folder`; whatever goes wrong, nothing is left in it, and OSErrors become ours."""
    try:
        _remove_dir(folder)
        _make_dir(folder)
        yield
    except OSError as error:
        _remove_dir(folder)
        raise storage_error(error, folder, doing=doing, needed_bytes=needed_bytes) from error
    except BaseException:
        _remove_dir(folder)
        raise


def _finish_motion(folder: Path, record: MotionRecord) -> None:
    """Write motion.json, and make the whole path to it durable."""
    write_record(folder / "motion.json", record)
    for parent in folder.parents[:3]:  # staging/shard-00000, staging, the dataset
        fsync_dir(parent)


def _remove_dir(folder: Path) -> None:
    """Remove a folder; motion.json goes first, so that half a motion never looks like a whole one."""
    if folder.exists():
        (folder / "motion.json").unlink(missing_ok=True)
        shutil.rmtree(folder)


def _make_dir(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise storage_error(error, folder, doing="making the folder") from error
