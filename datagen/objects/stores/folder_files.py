"""Every file below a folder that a user hands in: links followed once, what a system leaves behind skipped."""

import os
import stat
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

__all__ = ["FolderFiles", "FoundFile", "find_files", "pointed_to"]

# Not hidden, yet not the user's: resource forks in zips of a Mac, thumbnails and waste baskets of file servers.
_LEFT_BEHIND = ("__macosx", "@eadir", "$recycle.bin", "system volume information", "lost+found")

_LARGEST_POINTER = 1024  # bytes


@dataclass(frozen=True, kw_only=True)
class FoundFile:
    """One file, or a link that leads to none."""

    place: str  # relative to the folder, "/" between parts, as the disk spells it
    path: Path
    size: int
    modified_ns: int
    fault: str  # why it cannot be read; empty where nothing is known against it


@dataclass(frozen=True, kw_only=True)
class FolderFiles:
    """Files sorted by place."""

    files: tuple[FoundFile, ...]
    hidden: tuple[str, ...]  # places of hidden files and of what a system left behind
    unreadable: tuple[str, ...]  # folders, with the reason


@dataclass(frozen=True)
class _Entry:
    """An entry of a folder that is looked at."""

    path: Path
    place: str


def find_files(root: Path) -> FolderFiles:
    """All files below `root`, also by links to files and folders elsewhere; each folder once, so links may go round.

    A link to a file or folder that is reached without links is left out. Hidden files and folders
    (their name begins with a dot) are not looked at, nor is what systems leave behind.
    """
    walk = _Walk(root)
    files = sorted(walk.files(), key=lambda file: file.place)
    return FolderFiles(
        files=tuple(files), hidden=tuple(sorted(walk.hidden)), unreadable=tuple(walk.unreadable)
    )


class _Walk:
    """One walk; what is reached without links comes first and so keeps its own name."""

    def __init__(self, root: Path) -> None:
        self.hidden: list[str] = []
        self.unreadable: list[str] = []
        self._folders: set[tuple[int, int]] = set()  # device and inode of those that were entered
        self._known_files: set[tuple[int, int]] = set()  # of files that were found
        self._root = root

    def files(self) -> Iterator[FoundFile]:
        links: deque[_Entry] = deque()
        waiting = [_Entry(self._root, "")]
        while waiting or links:
            if not waiting:
                yield from self._followed(links.popleft(), waiting)
                continue
            inside, found_links = self._entered(waiting.pop())
            links += found_links
            for entry in inside:
                info = _stat(entry.path)
                if isinstance(info, os.stat_result) and stat.S_ISDIR(info.st_mode):
                    waiting.append(entry)
                else:
                    yield self._found(entry, info)

    def _entered(self, folder: _Entry) -> tuple[list[_Entry], list[_Entry]]:
        """Entries of a folder that is entered for the first time: those that are no links, and the links."""
        plain: list[_Entry] = []
        links: list[_Entry] = []
        try:
            info = os.stat(folder.path)
            if (info.st_dev, info.st_ino) in self._folders:
                return [], []
            self._folders.add((info.st_dev, info.st_ino))
            with os.scandir(folder.path) as entries:
                for entry in sorted(entries, key=lambda entry: entry.name):
                    place = f"{folder.place}/{entry.name}" if folder.place else entry.name
                    if entry.name.startswith(".") or entry.name.casefold() in _LEFT_BEHIND:
                        self.hidden.append(place)
                        continue
                    (links if entry.is_symlink() else plain).append(_Entry(folder.path / entry.name, place))
        except OSError as error:
            self.unreadable.append(f"{folder.place or folder.path} ({error.strerror})")
        return plain, links

    def _followed(self, link: _Entry, waiting: list[_Entry]) -> Iterator[FoundFile]:
        info = _stat(link.path)
        if isinstance(info, str):
            yield self._found(link, info)
        elif stat.S_ISDIR(info.st_mode):
            waiting.append(link)
        elif (info.st_dev, info.st_ino) not in self._known_files:
            yield self._found(link, info)

    def _found(self, entry: _Entry, info: os.stat_result | str) -> FoundFile:
        if isinstance(info, str):
            return FoundFile(place=entry.place, path=entry.path, size=0, modified_ns=0, fault=info)
        self._known_files.add((info.st_dev, info.st_ino))
        fault = ""
        if not stat.S_ISREG(info.st_mode):
            fault = "is a pipe, a socket or a device, not a file"
        elif not os.access(entry.path, os.R_OK):
            fault = "may not be read (its permissions forbid it)"
        return FoundFile(
            place=entry.place,
            path=entry.path,
            size=info.st_size,
            modified_ns=info.st_mtime_ns,
            fault=fault,
        )


def _stat(path: Path) -> os.stat_result | str:
    """Of what a link leads to; else what is wrong."""
    try:
        return os.stat(path)
    except OSError as error:
        if path.is_symlink():
            return f"is a link to {os.readlink(path)!r}, which is not there"
        return f"cannot be looked at ({error.strerror})"


def pointed_to(path: Path) -> str:
    """What stands in the file in place of its content; empty where it holds something else than a pointer.

    Pointers of Git LFS and git-annex, and symbolic links that were unpacked as text.
    """
    try:
        if path.stat().st_size > _LARGEST_POINTER:
            return ""
        text = path.read_bytes().decode("utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""
    if text.startswith("version https://git-lfs"):
        return "a Git LFS pointer"
    if "annex/objects/" in text.partition("\n")[0]:
        return "a pointer of git-annex"
    is_path = text.isprintable() and ("/" in text or Path(text).suffix.lower() == path.suffix.lower())
    return f"a link to {text!r} that was unpacked as text" if is_path and len(text.split()) == 1 else ""
