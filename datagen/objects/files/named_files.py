"""Files that a mesh file names: looked for as other systems would, opened only in its own folder."""

import os
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from datagen.objects.errors import ObjectError

__all__ = ["FoundFile", "NamedFiles", "spellings"]

QUOTES = ("'", '"')
MAX_CUTS = 8  # of a name with many '#'
MAX_TAIL = 4  # parts of a path that are looked for beside a file


@dataclass(frozen=True, kw_only=True)
class FoundFile:
    """A file on disk. `guessed`: it is not where its name says; the end of the name fits."""

    path: Path
    guessed: bool


class NamedFiles:
    """The files in the folder of `source` and below it; links that lead out of it are not followed.

    Where `source` is itself a link, files in the folder it leads to belong to it too.
    """

    def __init__(self, source: Path, max_file_mb: float) -> None:
        self._source, self._max_file_mb = source, max_file_mb
        self._roots = {_resolved(source.parent), _resolved(source).parent}

    def find(self, names: Sequence[str], folders: Sequence[Path]) -> FoundFile | None:
        """The first of `names` that leads to a file from one of `folders`.

        Letters may differ in case, backslashes count as slashes. Where none leads to a file inside,
        their ends are tried (`C:\\job\\maps\\wood.png` as `maps/wood.png` and as `wood.png`).
        """
        there = self.find_there(names, folders)
        if there is not None:
            return FoundFile(path=there, guessed=False)
        for parts in map(_parts, names):
            plain = tuple(part for part in parts if part != ".." and not _is_anchor(part))
            for tail in (plain[start:] for start in range(max(len(plain) - MAX_TAIL, 0), len(plain))):
                for folder in folders:
                    path = self._walk(folder, tail)
                    if path is not None:
                        return FoundFile(path=path, guessed=True)
        return None

    def find_there(self, names: Sequence[str], folders: Sequence[Path]) -> Path | None:
        """As `find`, but only where the names say. A backslash may also be part of a name (a zip of Windows)."""
        for name in names:
            for parts in dict.fromkeys((_parts(name), PurePosixPath(name).parts)):
                for folder in folders:
                    path = self._walk(folder, parts)
                    if path is not None:
                        return path
        return None

    def read(self, path: Path) -> bytes:
        """The content. ObjectError where it is too large or cannot be read."""
        try:
            size_mb = path.stat().st_size / 1e6
            data = path.read_bytes() if size_mb <= self._max_file_mb else None
        except OSError as error:
            raise ObjectError(
                path,
                f"cannot be read ({error.strerror})",
                expected="a readable file",
                action="Check its permissions and the disk.",
            ) from error
        if data is None:
            raise ObjectError(
                path,
                f"has {size_mb:.0f} MB",
                expected=f"at most {self._max_file_mb:g} MB",
                action="Make it smaller or raise `max_file_mb`.",
            )
        return data

    def _walk(self, folder: Path, parts: tuple[str, ...]) -> Path | None:
        if parts and _is_anchor(parts[0]):
            return self._inside(Path(*parts)) if parts[0] == "/" else None
        path = folder
        for part in parts:
            path = path.parent if part == ".." else path / part
            if not _exists(path):
                other = _other_case(path)
                if other is None:
                    return None
                path = other
        return self._inside(path)

    def _inside(self, path: Path) -> Path | None:
        """The file itself, None where there is none or it lies outside."""
        try:
            inside = any(path.resolve().is_relative_to(root) for root in self._roots)
            return path if inside and path.is_file() else None
        except (OSError, RuntimeError, ValueError):  # links in a circle, names that no disk can hold
            return None


def spellings(text: str) -> tuple[str, ...]:
    """What the rest of a line may mean as a name: as written, less a comment, quotes, %20."""
    text = text.strip()
    starts = [match.start() for match in re.finditer(r"\s#", text)][-MAX_CUTS:]
    cuts = [text, *(text[:start].rstrip() for start in reversed(starts))]
    forms = [form for cut in cuts for form in (cut, _unquoted(cut))]
    forms += [unquote(form) for form in forms if "%" in form]
    return tuple(dict.fromkeys(form for form in forms if form))


def _unquoted(text: str) -> str:
    quoted = len(text) >= 2 and text[0] == text[-1] and text[0] in QUOTES
    return text[1:-1].strip() if quoted else text


def _parts(name: str) -> tuple[str, ...]:
    """The parts of a path of any system; an absolute one begins with "/" or a drive such as "C:"."""
    parts = PurePosixPath(name.replace("\\", "/")).parts
    return ("/", *parts[1:]) if parts[:1] == ("//",) else parts


def _is_anchor(part: str) -> bool:
    return part == "/" or re.fullmatch(r"[A-Za-z][A-Za-z0-9+.-]*:", part) is not None


def _resolved(path: Path) -> Path:
    try:
        return path.resolve()
    except (OSError, RuntimeError):
        return path.absolute()


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def _other_case(path: Path) -> Path | None:
    """The one file of the same folder whose name differs in case or in composed accents only."""
    wanted = _folded(path.name)
    try:
        alike = [name for name in os.listdir(path.parent) if _folded(name) == wanted]
    except (OSError, ValueError):
        return None
    return path.parent / alike[0] if len(alike) == 1 else None


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()
