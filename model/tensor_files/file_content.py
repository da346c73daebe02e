"""What a file really is that was given as weights: told from its first bytes, before any library reads it."""

import json
import os
import re
import stat
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from model.errors import ModelError

__all__ = ["FileContent", "Mistaken", "check_file", "content_of", "mistaken_for"]

FileContent = Literal["safetensors", "torch", "other"]

_HEAD_BYTES = 512
_LARGEST_HEADER = 100_000_000  # the safetensors library reads no larger one
_ARCHIVE = "Unpack it, and give the file that was in it."
_AGAIN = "Download the file again."


@dataclass(frozen=True, kw_only=True)
class Mistaken:
    """A well-known thing that is no file of tensors, and how to come by the file that was meant."""

    what: str
    action: str


_POINTER = Mistaken(
    what="it is a Git LFS pointer, the file itself was not downloaded",
    action="Run `git lfs pull` in its folder, or download the file.",
)
_ANNEX = Mistaken(
    what="it is a git-annex pointer, the file itself was not downloaded",
    action="Run `git annex get` on it, or download the file.",
)
_PAGE = Mistaken(
    what="it is a web page, probably a login or error page",
    action="Log in where it comes from and download the file itself, not the page that shows it.",
)
_TEXT = Mistaken(what="it is JSON text, perhaps the error message of a server", action=_AGAIN)
_LINK = re.compile(r"(\.\.?/)+\S+")
_KNOWN_STARTS = (
    (b"version https://git-lfs", _POINTER),
    (b"version https://hawser", _POINTER),
    (b"/annex/objects/", _ANNEX),
    (b"<", _PAGE),
    (b"{", _TEXT),
    (b"[", _TEXT),
    (b"GGUF", Mistaken(what="it is a GGUF file of quantised weights", action="Give the original file.")),
    (b"PK", Mistaken(what="it is a zip archive without tensors", action=_ARCHIVE)),
    (b"\x1f\x8b", Mistaken(what="it is a gzip archive", action=_ARCHIVE)),
    (b"7z\xbc\xaf", Mistaken(what="it is a 7z archive", action=_ARCHIVE)),
    (b"\x28\xb5\x2f\xfd", Mistaken(what="it is a zstd archive", action=_ARCHIVE)),
    (b"\x93NUMPY", Mistaken(what="it is a NumPy array", action="Give the original file.")),
    (b"\x89HDF", Mistaken(what="it is an HDF5 file", action="Give the original file.")),
)


def check_file(path: Path, *, expected: str, action: str) -> None:
    """ModelError unless `path` is a regular file that libraries can open. Opens no pipes and no devices."""
    try:
        mode = path.stat().st_mode
        if stat.S_ISREG(mode):
            str(path).encode("utf-8")
            with path.open("rb"):
                return
        problem = f"is {_kind(mode)}, not a file"
    except UnicodeEncodeError:
        problem = "its path holds bytes that are no UTF-8, which the safetensors library does not open"
        action = "Rename the file or folder."
    except FileNotFoundError:
        problem = "there is no such file"
        if path.is_symlink():
            problem = f"is a link to {os.readlink(path)}, where there is no file"
            action = "The download is not complete: run it again, or give the file itself."
    except OSError as error:
        problem = f"cannot be read ({error.strerror})"
        action = "Check the path and its permissions."
    raise ModelError(path, problem, expected=expected, action=action)


def content_of(path: Path) -> FileContent:
    """Told from a readable file's bytes, not from its name. "torch" is what torch.save writes, also before 1.6."""
    with path.open("rb") as file:
        head = file.read(16)
    length = int.from_bytes(head[:8], "little")
    if head[8:9] == b"{" and length <= _LARGEST_HEADER:
        return "safetensors"
    if head.startswith(b"PK") and zipfile.is_zipfile(path):
        return "torch" if _holds_pickle(path) else "other"
    return "torch" if head[:1] == b"\x80" and head[1:2] in b"\x02\x03\x04\x05" else "other"


def mistaken_for(path: Path) -> Mistaken | None:
    """Why a readable file cannot be read as safetensors; None when its bytes say nothing known."""
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
        n_bytes = os.fstat(file.fileno()).st_size
    if not head:
        return Mistaken(what="it is empty", action=_AGAIN)
    if content_of(path) == "safetensors":
        return _other_length(path, n_bytes)
    if head.startswith(b"PK") and not zipfile.is_zipfile(path):
        what = (
            f"it is a zip archive or torch checkpoint cut off after {n_bytes} bytes: an interrupted download"
        )
        return Mistaken(what=what, action=_AGAIN)
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if known := next((known for start, known in _KNOWN_STARTS if text.startswith(start)), None):
        return known
    if not head.strip(b"\0"):
        what = f"its first {len(head)} bytes are zero: disk space was reserved and never filled"
        return Mistaken(what=what, action=_AGAIN)
    return _short_text(head) if len(head) < _HEAD_BYTES else None


def _short_text(content: bytes) -> Mistaken | None:
    if not content.isascii():
        return None
    text = content.decode("ascii").strip()
    if not text.isprintable():
        return None
    if _LINK.fullmatch(text):
        return Mistaken(
            what=f"it is the text of a link to {text}, as a copy without links leaves it",
            action="Copy the folder with its links (cp -a, rsync -a), or download it again.",
        )
    return Mistaken(what=f"it is the text '{text[:60]}'", action=_AGAIN)


def _other_length(path: Path, n_bytes: int) -> Mistaken | None:
    """Whether the file is shorter or longer than its own header announces."""
    with path.open("rb") as file:
        end = 8 + int.from_bytes(file.read(8), "little")
        if n_bytes >= end:
            try:
                header = json.loads(file.read(end - 8))
                end += max(
                    (entry["data_offsets"][1] for entry in header.values() if "dtype" in entry), default=0
                )
            except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
                return None
    if n_bytes == end:
        return None
    if n_bytes < end:
        return Mistaken(what=f"it has {n_bytes} of {end} bytes: an interrupted download", action=_AGAIN)
    return Mistaken(what=f"{n_bytes - end} bytes follow its last tensor", action=_AGAIN)


def _kind(mode: int) -> str:
    if stat.S_ISDIR(mode):
        return "a folder"
    return "a named pipe" if stat.S_ISFIFO(mode) else "a device or socket"


def _holds_pickle(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith("data.pkl") for name in archive.namelist())
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return False
