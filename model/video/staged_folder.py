"""staged_folder: results appear under their name all at once, or not at all."""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path

from model.errors import ModelError

__all__ = ["MANIFEST", "staged_folder"]

# Lists what was written, so that overwriting can tell our files from anybody else's.
MANIFEST = ".forehoi-files.json"


@contextmanager
def staged_folder(out: Path, *, overwrite: bool) -> Iterator[Path]:
    """A folder to write into, beside `out`, that is renamed to `out` when the block ends without error.

    An existing `out` must be an empty folder. With `overwrite` it may hold an earlier result instead,
    which is replaced, but only if every file in it is one that was written here and has not changed
    since. ModelError otherwise, before any work is done; `out` is then as it was.
    """
    out = Path(os.path.abspath(out))
    _replaceable(out, overwrite=overwrite)
    missing_parents = [parent for parent in out.parents if not parent.exists()]
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}.partial-"))
    except OSError as error:
        raise ModelError(
            out, f"cannot be written ({error.strerror})", expected="a writable place", action="Change --out."
        ) from error
    try:
        yield partial
        _finish(partial, out, overwrite=overwrite)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        for parent in missing_parents:
            if parent.is_dir() and not any(parent.iterdir()):
                parent.rmdir()
        raise


def _finish(partial: Path, out: Path, *, overwrite: bool) -> None:
    written = {name: _digest(partial / name) for name in _files(partial)}
    (partial / MANIFEST).write_text(json.dumps(written, indent=1) + "\n")
    partial.chmod(0o755)  # mkdtemp's is for the owner alone
    earlier = _replaceable(out, overwrite=overwrite)  # once more: the work took time
    if not earlier:
        if out.exists():
            out.rmdir()
        partial.rename(out)
        return
    aside = partial.with_name(partial.name.replace(".partial-", ".earlier-"))
    out.rename(aside)
    partial.rename(out)
    for name in earlier:
        (aside / name).unlink()
    for folder in sorted((path for path in aside.rglob("*") if path.is_dir()), reverse=True):
        folder.rmdir()
    aside.rmdir()


def _replaceable(out: Path, *, overwrite: bool) -> list[str]:
    """Files of an earlier result at `out`, none if there is nothing. ModelError if it must stay."""
    if out.is_symlink() or (out.exists() and not out.is_dir()):
        raise ModelError(out, "exists and is not a folder", expected="a new folder", action="Change --out.")
    if not out.exists() or not any(out.iterdir()):
        return []
    if not overwrite:
        raise ModelError(
            out,
            "exists and is not empty",
            expected="a new folder",
            action="Change --out, or use --overwrite.",
        )
    known = _manifest(out)
    for name in _files(out):
        if name != MANIFEST and known.get(name) != _digest(out / name):
            raise ModelError(
                out,
                f"'{name}' was not written by this program, or was changed since",
                expected="only files of an earlier result",
                action="Move it away, or change --out. Nothing was deleted.",
            )
    return _files(out)


def _manifest(out: Path) -> dict[str, str]:
    try:
        known = json.loads((out / MANIFEST).read_text())
    except (OSError, ValueError):
        return {}
    return known if isinstance(known, dict) else {}


def _files(folder: Path) -> list[str]:
    """Everything that is not a folder, relative; a link counts as a file."""
    return sorted(
        str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_symlink() or not path.is_dir()
    )


def _digest(path: Path) -> str:
    """SHA-256; of a link the place it points to, so that it never equals a file."""
    data = f"-> {os.readlink(path)}".encode() if path.is_symlink() else path.read_bytes()
    return sha256(data).hexdigest()
