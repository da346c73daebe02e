"""Which row of objects.csv tells about which object of the folder, however the row spells the path."""

import difflib
import posixpath
import unicodedata
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath

from datagen.objects.catalogue.objects_table import ObjectRow, ObjectTable
from datagen.objects.errors import ObjectError

__all__ = ["rows_of_objects"]

_SHOWN = 5  # rows that a note names


def rows_of_objects(
    table: ObjectTable, source: Path, places: Mapping[str, Sequence[str]]
) -> tuple[dict[str, ObjectRow], tuple[str, ...]]:
    """The row of each object that has one, by uid, and notes on rows that fit nothing.

    `places` holds the files of each uid, the drawn one first. A row fits a file where its path does,
    however separators, letter case (if only one file fits then) and accents are written, or fits an
    object by its path without suffix, or by its folder. Where rows of several files of one object
    differ, that of the drawn file counts. ObjectError where this leaves two different rows.
    """
    finder = _Finder(source.parent, places)
    of_uid: dict[str, list[tuple[str, ObjectRow]]] = defaultdict(list)
    lost: list[ObjectRow] = []
    for row in table.rows:
        found = finder.find(row.path)
        if found is None:
            lost.append(row)
        else:
            uid, place = found
            of_uid[uid].append((place, row))
    chosen = {uid: _one_row(source, rows, places[uid][0]) for uid, rows in of_uid.items()}
    notes = list(table.notes)
    if lost:
        more = f" and {len(lost) - _SHOWN:,} more" if len(lost) > _SHOWN else ""
        named = "; ".join(_named(row, finder.closest(row.path)) for row in lost[:_SHOWN])
        notes.append(f"{source.name}: no mesh file, or more than one, fits {named}{more}")
    return chosen, tuple(notes)


def _named(row: ObjectRow, close: str) -> str:
    return f"row {row.number} ({row.path}" + (f"; did you mean {close}?)" if close else ")")


def _one_row(source: Path, rows: Sequence[tuple[str, ObjectRow]], drawn: str) -> ObjectRow:
    of_drawn = [row for place, row in rows if place == drawn]
    candidates = of_drawn or [row for _, row in rows]
    first = candidates[0]
    other = next((row for row in candidates if row.told != first.told), None)
    if other is not None:
        raise ObjectError(
            source,
            f"rows {first.number} ({first.path}) and {other.number} ({other.path}) tell different things "
            "of one object",
            expected="one row for each object, or the same in all of them",
            action="Delete one of the rows.",
        )
    return first


class _Finder:
    """From a path as a row spells it to an object and its file."""

    def __init__(self, folder: Path, places: Mapping[str, Sequence[str]]) -> None:
        self._folder = folder
        self._exact: dict[str, tuple[str, str]] = {}
        self._loose: dict[str, set[tuple[str, str]]] = defaultdict(set)
        self._objects: dict[str, set[str]] = defaultdict(set)
        self._folders: dict[str, set[str]] = defaultdict(set)
        self._drawn = {uid: files[0] for uid, files in places.items()}
        for uid, files in places.items():
            for place in files:
                written = _normal(place)
                self._exact[place] = self._exact[written] = (uid, place)
                self._loose[written.casefold()].add((uid, place))
                self._objects[posixpath.splitext(written)[0].casefold()].add(uid)
                for parent in PurePosixPath(written.casefold()).parents:
                    self._folders[str(parent)].add(uid)
            self._objects[_normal(uid.partition("/")[2]).casefold()].add(uid)

    def find(self, path: str) -> tuple[str, str] | None:
        """Uid and place of the one file that fits; None where none does, or several."""
        for written in (path, self._relative(path)):
            if written in self._exact:
                return self._exact[written]
        loose = self._relative(path).casefold()
        if len(self._loose.get(loose, ())) == 1:
            return next(iter(self._loose[loose]))
        uids = self._objects.get(loose) or self._folders.get(loose) or set()
        if len(uids) == 1 and loose not in self._loose:
            uid = next(iter(uids))
            return uid, self._drawn[uid]
        return None

    def closest(self, path: str) -> str:
        """The file that is spelled most alike; empty where none is."""
        known = sorted(place for _, place in self._exact.values())[:20000]
        close = difflib.get_close_matches(self._relative(path), known, n=1, cutoff=0.8)
        return close[0] if close else ""

    def _relative(self, path: str) -> str:
        """With "/" between parts, without "." and "..", relative to the folder."""
        written = _normal(path.strip().strip("\"'").strip().replace("\\", "/"))
        folder = _normal(str(self._folder.resolve()))
        if written.startswith(f"{folder}/"):
            written = written[len(folder) + 1 :]
        return posixpath.normpath(written) if written else written


def _normal(text: str) -> str:
    return unicodedata.normalize("NFC", text)
