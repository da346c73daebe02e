"""The MTL files of an OBJ file, and the entry that a usemtl line means."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from datagen.objects.errors import ObjectError
from datagen.objects.files.decoded_text import decoded_text
from datagen.objects.files.named_files import NamedFiles, spellings
from datagen.objects.wavefront.lines import shown
from datagen.objects.wavefront.mtl_file import MtlEntry, read_mtl

__all__ = ["FoundEntry", "MtlLibraries"]

SEVERAL = re.compile(r"\"[^\"]+\"|'[^']+'|\S[^\"']*?\.mtl(?!\S)|\S+", re.IGNORECASE)
MAX_LINE_CHARS = 4096  # of an mtllib line that is taken for several names
NO_MATERIAL = ("(null)", "null", "none")  # what some exporters write in place of a name


@dataclass(frozen=True, kw_only=True)
class FoundEntry:
    """An entry and the MTL file it stands in."""

    entry: MtlEntry
    path: Path


class MtlLibraries:
    """All entries of the files that the mtllib lines name; of two of one name the later file's counts.

    Where none of them is there, a file named after the OBJ is taken. `notes` tells of guesses.
    """

    def __init__(self, path: Path, files: NamedFiles, lines: tuple[str, ...]) -> None:
        self._path, self._files = path, files
        self._entries: dict[str, FoundEntry] = {}
        self._spelled_names: dict[str, set[str]] = {}  # names of entries by what else they may mean
        self._folded_names: dict[str, set[str]] = {}  # the same without regard to case and blanks
        self._read: list[str] = []
        self._missing: list[str] = []
        self._has_guessed = False
        self.notes: list[str] = []
        for line in dict.fromkeys(lines):
            for name in self._names(line):
                self._add(name)

    def find(self, name: str) -> FoundEntry | None:
        """The entry that `usemtl name` means; None where no file was to tell.

        Exact names go before those that differ by a comment, quotes, blanks or case. ObjectError
        where a library is missing or tells of other materials only.
        """
        found = self._known(name)
        if found is None and not self._read and not self._has_guessed:
            self._add_namesake()
            found = self._known(name)
        if found is not None or not (self._read or self._missing) or name.lower() in NO_MATERIAL:
            return found
        if self._missing:
            raise ObjectError(
                self._path,
                f"material library {shown(self._missing[0])} is missing, and with it material {shown(name)}",
                expected=f"that file in {self._path.parent} or below",
                action="Put the MTL file there or remove the mtllib line.",
            )
        raise ObjectError(
            self._path,
            f"material {shown(name)} is in none of {self._read[:5]}",
            expected="every usemtl name in an MTL file",
            action="Add the material to the MTL file or remove the usemtl line.",
        )

    def _names(self, line: str) -> Iterator[str]:
        """One name with blanks, or several names."""
        found = self._files.find(spellings(line), (self._path.parent,))
        pieces = [piece.strip() for piece in SEVERAL.findall(line[:MAX_LINE_CHARS])]
        if (found is not None and not found.guessed) or len(pieces) < 2:
            yield line
        else:
            yield from pieces[: pieces.index("#")] if "#" in pieces else pieces

    def _add(self, name: str) -> None:
        found = self._files.find(spellings(name), (self._path.parent,))
        if found is None:
            self._missing.append(name)
            self.notes.append(f"material library {shown(name)} is missing")
            return
        if found.guessed:
            self.notes.append(
                f"material library {shown(name)} is read from {found.path.name!r} beside the OBJ"
            )
        self._add_file(found.path)

    def _add_file(self, path: Path) -> None:
        self._read.append(path.name)
        entries = read_mtl(path, decoded_text(path, self._files.read(path)))
        for name, entry in entries.items():
            if name in self._entries and self._entries[name].entry != entry:
                self.notes.append(f"material {shown(name)} is in two libraries; that of {path.name!r} counts")
            self._entries[name] = FoundEntry(entry=entry, path=path)
            self._folded_names.setdefault(_folded(name), set()).add(name)
            for form in spellings(name):
                self._spelled_names.setdefault(form, set()).add(name)

    def _add_namesake(self) -> None:
        self._has_guessed = True
        names = (f"{self._path.stem}.mtl", f"{self._path.name}.mtl")
        found = self._files.find(names, (self._path.parent,))
        if found is not None:
            self.notes.append(f"no mtllib line names a file that is there; {found.path.name!r} is read")
            self._missing.clear()
            self._add_file(found.path)

    def _known(self, name: str) -> FoundEntry | None:
        return self._entries.get(name) or self._spelled(name) or self._folded(name)

    def _spelled(self, name: str) -> FoundEntry | None:
        """The entry of a name that differs by a comment, quotes or %20 on one of the two sides."""
        for form in spellings(name):
            if form in self._entries:
                return self._entries[form]
        return self._only(self._spelled_names.get(name))

    def _folded(self, name: str) -> FoundEntry | None:
        found = self._only(self._folded_names.get(_folded(name)))
        if found is not None:
            self.notes.append(f"material {shown(name)} is taken to be {shown(found.entry.name)}")
        return found

    def _only(self, names: set[str] | None) -> FoundEntry | None:
        return self._entries[next(iter(names))] if names is not None and len(names) == 1 else None


def _folded(name: str) -> str:
    return " ".join(name.strip("\"'").split()).casefold()
