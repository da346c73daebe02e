"""Everything that can be wrong with a dataset, in one family.

    ShardError (a ValueError)
    ├── DatasetNotFoundError   no dataset.json, shard or clip where one was expected
    ├── SchemaVersionError     written in a schema version this reader does not know
    ├── IncompleteShardError   not every motion is there yet: unfinished, or being written
    ├── CorruptShardError      the bytes are not those that were written
    │   ├── ChecksumError      same length, other content
    │   └── TruncatedError     shorter (or longer) than recorded
    ├── MissingColumnError     a column that is not in the file, or was not asked for
    ├── RowError               a value that does not fit the schema
    ├── SplitError             one object in two splits
    ├── ImageError             image bytes that cannot be encoded or decoded
    └── StorageError           the disk refused to take or give something
        └── DiskFullError      no space, quota or file-size limit

Each message says what is wrong, where, what was expected and found, and what to do.
"""

import errno
import shutil
from pathlib import Path

__all__ = [
    "ChecksumError",
    "CorruptShardError",
    "DatasetNotFoundError",
    "DiskFullError",
    "ImageError",
    "IncompleteShardError",
    "MissingColumnError",
    "RowError",
    "SchemaVersionError",
    "ShardError",
    "SplitError",
    "StorageError",
    "TruncatedError",
    "storage_error",
]

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


class ShardError(ValueError):
    """Base of the family. `str(error)` is one complete line, `problem` what is wrong without the rest."""

    def __init__(
        self,
        problem: str,
        *,
        where: str = "",
        row: int | str | None = None,
        column: str | None = None,
        expected: object = None,
        found: object = None,
        fix: str = "",
    ) -> None:
        self.problem = problem
        place = [where] if where else []
        place += [f"row {row}"] if row is not None else []
        place += [f"column '{column}'"] if column is not None else []
        seen = [f"expected {expected}"] if expected is not None else []
        seen += [f"found {found}"] if found is not None else []
        text = f"{', '.join(place)}: {problem}" if place else problem
        text += f" ({', '.join(seen)})" if seen else ""
        super().__init__(f"{text}; {fix}" if fix else text)


class DatasetNotFoundError(ShardError):
    """There is no dataset, shard or clip of that name."""


class SchemaVersionError(ShardError):
    """The data were written in a schema version this reader does not know."""


class IncompleteShardError(ShardError):
    """A shard lacks motions or its shard.json: it is unfinished."""


class CorruptShardError(ShardError):
    """The bytes are not those that were written."""


class ChecksumError(CorruptShardError):
    """A checksum does not match."""


class TruncatedError(CorruptShardError):
    """A file is shorter or longer than recorded."""


class MissingColumnError(ShardError):
    """A column is not in the file, or was not asked for when it was read."""


class RowError(ShardError):
    """A value does not fit its column."""


class SplitError(ShardError):
    """One object is in two splits, so that what is tested on was trained on."""


class ImageError(ShardError):
    """Image bytes cannot be encoded or decoded."""


class StorageError(ShardError):
    """The file system refused an operation."""


class DiskFullError(StorageError):
    """No space is left, or a quota or file-size limit was reached."""


def storage_error(error: OSError, path: Path, *, doing: str, needed_bytes: int | None = None) -> StorageError:
    """The ShardError for an OSError that happened while `doing` something at `path`."""
    if error.errno not in _FULL:
        return StorageError(f"{doing} failed: {error}", where=str(path), fix="check permissions and the disk")
    need = "" if needed_bytes is None else f"{needed_bytes / 1e6:.1f} MB needed, "
    free = shutil.disk_usage(_existing_parent(path)).free
    limit = "file-size limit or quota reached" if error.errno != errno.ENOSPC else "no space left"
    return DiskFullError(
        f"{doing} failed: {limit} ({need}{free / 1e6:.1f} MB free)",
        where=str(path),
        fix="finished motions are kept: make room and run the same command again",
    )


def _existing_parent(path: Path) -> Path:
    while not path.exists() and path != path.parent:
        path = path.parent
    return path
