"""Files that appear under their name all at once, or not at all."""

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["fsync_dir", "fsync_file", "write_whole"]


@contextmanager
def write_whole(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """A new place beside `path` to write to; it becomes `path` when the block ends without error.

    Otherwise it is deleted and `path` stays as it was. Any number of processes and machines may write the
    same file at once: the last one wins. `durable`: content and name also survive a power cut. The folder
    has to exist.
    """
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}.partial")
    try:
        yield partial
        if durable:
            fsync_file(partial)
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    if durable:
        fsync_dir(path.parent)


def fsync_file(path: Path) -> None:
    """Force a file's content to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


fsync_dir = fsync_file  # a directory's entries, by the same call
