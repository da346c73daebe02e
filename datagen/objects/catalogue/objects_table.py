"""objects.csv: what a user writes down about the objects of a folder, as spreadsheets save it."""

import csv
import io
import re
import unicodedata
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from datagen.objects.catalogue.licences import joined_licences, licence_parts, spdx_of
from datagen.objects.errors import ObjectError

__all__ = ["TABLE_NAME", "ObjectRow", "ObjectTable", "read_objects_table"]

TABLE_NAME = "objects.csv"
_MAX_BYTES = 64_000_000  # some 500,000 rows
_DELIMITERS = (",", ";", "\t", "|")
# What a column may be called, in any case; of several the first counts.
_COLUMNS = {
    "path": ("path", "file", "filename", "file_name", "file name"),
    "name": ("name",),
    "licence": ("licence", "license"),
    "author": ("author",),
    "url": ("url",),
}
_EXCEL_HINT = re.compile(
    r'\A"?sep=.?"?[ \t]*\r?\n', re.IGNORECASE
)  # names the delimiter; Excel does not show it
_BYTE_ORDER_MARKS = (
    (b"\xef\xbb\xbf", "utf-8-sig"),
    (b"\xff\xfe\x00\x00", "utf-32"),
    (b"\x00\x00\xfe\xff", "utf-32"),
    (b"\xff\xfe", "utf-16"),
    (b"\xfe\xff", "utf-16"),
)
_KNOWN_STARTS = (
    (b"PK\x03\x04", "is a workbook (or another zip archive)"),
    (b"\xd0\xcf\x11\xe0", "is a workbook of old Excel"),
    (b"version https://git-lfs", "is a Git LFS pointer, not the table"),
)


@dataclass(frozen=True, kw_only=True)
class ObjectRow:
    """One row; empty where it does not tell."""

    number: int  # as a spreadsheet counts: the header is row 1
    path: str  # as written
    name: str
    licence: str  # SPDX id, or several joined by AND
    author: str
    url: str

    @property
    def told(self) -> tuple[str, str, str, str]:
        """All but where it stands."""
        return self.name, self.licence, self.author, self.url


@dataclass(frozen=True, kw_only=True)
class ObjectTable:
    """The rows that name a path, and what had to be guessed to read them."""

    rows: tuple[ObjectRow, ...]
    notes: tuple[str, ...]


def read_objects_table(path: Path) -> ObjectTable:
    """Any encoding with a byte order mark, UTF-8, UTF-16 or Windows-1252; cells apart by ',', ';', tab or '|'.

    Columns in any order and case: path (or file), name, licence (or license; as `spdx_of` takes it),
    author, url; others are ignored. ObjectError names the row that cannot be read.
    """
    text, notes = _decoded(path, _bytes_of(path))
    records = _records(path, _EXCEL_HINT.sub("", text, count=1))
    if not records:
        return ObjectTable(rows=(), notes=notes)
    columns = _columns(path, records[0][1])
    width = len(records[0][1])
    rows = [_row(path, number, cells, columns, width) for number, cells in records[1:]]
    return ObjectTable(rows=tuple(row for row in rows if row is not None), notes=notes)


def _refused(path: Path, problem: str, expected: str, action: str) -> ObjectError:
    return ObjectError(path, problem, expected=expected, action=action)


def _bytes_of(path: Path) -> bytes:
    try:
        if path.is_file() and path.stat().st_size > _MAX_BYTES:
            raise _refused(
                path,
                f"has {path.stat().st_size / 1e6:.0f} MB",
                f"a table of at most {_MAX_BYTES / 1e6:.0f} MB",
                "Keep the rows of this folder only.",
            )
        if not path.is_file():
            raise FileNotFoundError(0, "a dangling link, a folder or no regular file")
        data = path.read_bytes()
    except OSError as error:
        raise _refused(
            path,
            f"cannot be read ({error.strerror})",
            "a readable table",
            "Mend the file, or move it away: licences are then NOASSERTION.",
        ) from error
    known = next((what for start, what in _KNOWN_STARTS if data.startswith(start)), None)
    if known is not None:
        raise _not_text(path, known)
    return data


def _not_text(path: Path, problem: str) -> ObjectError:
    return _refused(
        path, problem, "text with a header line", "Save the table as 'CSV UTF-8' under this name."
    )


def _decoded(path: Path, data: bytes) -> tuple[str, tuple[str, ...]]:
    """The text, and a note where its encoding was a guess."""
    marked = next((encoding for mark, encoding in _BYTE_ORDER_MARKS if data.startswith(mark)), None)
    notes: tuple[str, ...] = ()
    if marked is None and b"\x00" in data:
        # Text of mostly Latin letters has its zeros in every other byte.
        marked = "utf-16-le" if data[1::2].count(0) > data[0::2].count(0) else "utf-16-be"
    try:
        text = data.decode(marked or "utf-8")
    except UnicodeDecodeError as error:
        if marked is not None:
            raise _not_text(path, f"is not text ({error.reason})") from error
        text = data.decode("cp1252", errors="replace")
        notes = (f"{path.name}: not UTF-8, read as Windows-1252; check names with accents",)
    if any(unicodedata.category(character) == "Cc" and not character.isspace() for character in text[:4096]):
        raise _not_text(path, "is not text (it holds control characters)")
    return text.lstrip("\ufeff"), notes


def _records(path: Path, text: str) -> list[tuple[int, list[str]]]:
    """Records that are not empty, with their numbers."""
    reader = _reader(text, _delimiter(text))
    records: list[tuple[int, list[str]]] = []
    try:
        for number, cells in enumerate(reader, start=1):
            stripped = [cell.strip() for cell in cells]
            if any(stripped):
                records.append((number, stripped))
    except csv.Error as error:
        after = f"row {records[-1][0]}" if records else "the beginning"
        raise _refused(
            path,
            f"cannot be read after {after} ({error})",
            "cells in quotation marks that are closed, with marks inside them doubled",
            "Mend the quotation marks there.",
        ) from error
    return records


def _reader(text: str, delimiter: str) -> Iterator[list[str]]:
    return csv.reader(
        io.StringIO(text, newline=""), delimiter=delimiter, skipinitialspace=delimiter != "\t", strict=True
    )


def _delimiter(text: str) -> str:
    """The one at which the header falls into most columns that we know."""
    names = {alias for aliases in _COLUMNS.values() for alias in aliases}
    header = next((line for line in text.splitlines() if line.strip()), "")

    def known(delimiter: str) -> int:
        try:
            return sum(cell.strip().casefold() in names for cell in next(_reader(header, delimiter), []))
        except csv.Error:
            return 0

    return max(_DELIMITERS, key=known)


def _columns(path: Path, header: list[str]) -> dict[str, int]:
    """Place of each column that we know."""
    columns: dict[str, int] = {}
    lower = [written.casefold() for written in header]
    for name, aliases in _COLUMNS.items():
        given = [alias for alias in aliases if alias in lower]
        twice = next((alias for alias in given if lower.count(alias) > 1), None)
        if twice is not None or (name == "licence" and len(given) > 1):
            raise _refused(
                path,
                f"has the column {name!r} twice",
                "each column once",
                "Rename or delete one of them.",
            )
        if given:
            columns[name] = lower.index(given[0])
    if "path" not in columns:
        raise _refused(
            path,
            f"has no column 'path' (found: {', '.join(header)[:120]})",
            "columns path, name, licence, author, url",
            "Add the header line.",
        )
    return columns


def _row(
    path: Path, number: int, cells: list[str], columns: dict[str, int], n_columns: int
) -> ObjectRow | None:
    """None for a row that names no path."""
    if any(cells[n_columns:]):
        raise _refused(
            path,
            f"row {number} has {len(cells)} cells, the header {n_columns}",
            "a cell for each column",
            "Put cells that hold the delimiter in quotation marks.",
        )
    told = {name: cells[place] if place < len(cells) else "" for name, place in columns.items()}
    if not told["path"]:
        return None
    return ObjectRow(
        number=number,
        path=told["path"],
        name=told.get("name", ""),
        licence=_licence(path, number, told["path"], told.get("licence", "")),
        author=told.get("author", ""),
        url=told.get("url", ""),
    )


def _licence(path: Path, number: int, file: str, written: str) -> str:
    """SPDX id (or several joined by AND); empty where the row does not tell."""
    try:
        return joined_licences(*map(spdx_of, licence_parts(written))) if written else ""
    except ObjectError as error:
        raise ObjectError(
            path,
            f"row {number} ({file}): the licence {written!r} is not known",
            expected=error.expected,
            action=error.action,
        ) from error
