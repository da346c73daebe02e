"""The JSON files: dataset.json, shard.json and the motion.json of a staged motion.

Each is written whole or not at all, and carries the SHA-256 of its own content, so that a damaged
one is recognised.
"""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeVar

from shards.errors import ChecksumError, CorruptShardError, SchemaVersionError, storage_error
from shards.schema import SCHEMA_VERSION
from shards.settings import SettingsError, settings_from_dict
from shards.splits import SplitRule
from shards.storage.whole_file import write_whole

__all__ = [
    "DatasetRecord",
    "FileRecord",
    "MotionRecord",
    "Provenance",
    "ShardRecord",
    "check_schema_version",
    "parse_record",
    "write_record",
]

Record = TypeVar("Record")


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """What made the data: a commit of the generator and the hash of its complete configuration."""

    generator_commit: str
    config_sha256: str


@dataclass(frozen=True, kw_only=True)
class DatasetRecord:
    """dataset.json"""

    schema_version: str
    name: str
    conventions: str
    provenance: Provenance
    config_yaml: str
    split_rule: SplitRule


@dataclass(frozen=True, kw_only=True)
class FileRecord:
    """One Parquet file: whole-file SHA-256, and what lets a reader check the parts it fetches."""

    n_bytes: int
    sha256: str
    rows: int
    footer_bytes: int
    footer_sha256: str
    chunk_crc32: str  # 8 hex digits per column chunk, row group by row group


@dataclass(frozen=True, kw_only=True)
class MotionRecord:
    """motion.json of a staged motion, and its entry in shard.json. A skipped motion has no files."""

    motion_index: int
    schema_version: str
    provenance: Provenance
    skip_reason: str | None
    clip_ids: tuple[str, ...]
    timings_s: dict[str, float]
    files: dict[str, FileRecord]


@dataclass(frozen=True, kw_only=True)
class ShardRecord:
    """shard.json: written last, so a shard without it does not exist."""

    shard: int
    schema_version: str
    provenance: Provenance
    files: dict[str, FileRecord]
    motions: tuple[MotionRecord, ...]

    @property
    def clip_ids(self) -> tuple[str, ...]:
        """Clips of the shard in file order: row i of clips.parquet, row group i of frames.parquet."""
        return tuple(clip_id for motion in self.motions for clip_id in motion.clip_ids)

    @property
    def skipped(self) -> tuple[MotionRecord, ...]:
        """Motions that were planned but are not there, with `skip_reason`."""
        return tuple(motion for motion in self.motions if motion.skip_reason is not None)


def write_record(path: Path, record: object) -> None:
    """Write a record dataclass at `path` in one durable step. Raises StorageError."""
    content = asdict(record)  # type: ignore[call-overload]
    text = json.dumps(
        {"sha256": _digest(content), "record": content}, indent=1, sort_keys=True, ensure_ascii=False
    )
    try:
        with write_whole(path, durable=True) as partial:
            partial.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise storage_error(error, path, doing="writing", needed_bytes=len(text)) from error


def parse_record(data: bytes, record_type: type[Record], *, where: str) -> Record:
    """The record in `data`, the content of file `where`. Raises CorruptShardError, SchemaVersionError."""
    try:
        document = json.loads(data)
        content, digest = document["record"], document["sha256"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise CorruptShardError(f"not a readable record: {error}", where=where, fix=_RESTORE) from error
    if digest != _digest(content):
        raise ChecksumError("the content does not match its own SHA-256", where=where, fix=_RESTORE)
    check_schema_version(str(content.get("schema_version")), where=where)
    try:
        return settings_from_dict(record_type, content, where)
    except SettingsError as error:
        raise CorruptShardError(str(error), fix=_RESTORE) from error


def check_schema_version(version: str, *, where: str) -> None:
    """Accept the same major version up to our minor version; else SchemaVersionError."""
    try:
        major, minor, _ = (int(part) for part in version.split("."))
    except ValueError:
        raise CorruptShardError(
            "unreadable schema version", where=where, expected="X.Y.Z", found=version
        ) from None
    our_major, our_minor, _ = (int(part) for part in SCHEMA_VERSION.split("."))
    if (major, minor) > (our_major, our_minor):
        fix = "update the shards package (pip install -U forehoi-open) to read it"
        raise SchemaVersionError("newer schema", where=where, expected=SCHEMA_VERSION, found=version, fix=fix)
    if major < our_major:
        fix = f"read it with a release of schema {major}.x, or render it again"
        raise SchemaVersionError("older schema", where=where, expected=SCHEMA_VERSION, found=version, fix=fix)


_RESTORE = "restore the file from another copy, or delete its shard and make it again"


def _digest(content: object) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()
