"""FramePages: single images of a frames.parquet on the local disk, without the rest of their clip.

Blob columns are uncompressed and paged so that one frame can be fetched (shards/parquet.py). Reading one
page instead of a clip's whole column chunk matters when the data do not fit the memory: a sample sees
one or two frames of a clip of many.

The CRC-32 in shard.json is of whole chunks, so other checks take its place: the page's own CRC-32;
and its headers, which Parquet leaves unprotected, must divide the chunk into exactly its bytes and rows,
which are known from the footer (SHA-256 checked). Page header: parquet.thrift, compact protocol.
"""

import os
import zlib
from dataclasses import dataclass
from typing import Any

from fsspec.implementations.local import LocalFileSystem

from shards.errors import ChecksumError, CorruptShardError, StorageError
from shards.storage.bounded_cache import BoundedCache
from shards.storage.parquet import COPY_AGAIN, ParquetSource

__all__ = ["FramePages", "local_pages"]

_HEADER_BYTES = 128  # more than a page header without statistics takes
_MAX_TABLES = 100_000  # page tables kept, a few hundred bytes each
_DATA_PAGE, _PLAIN = 0, 0
_TRUE, _FALSE, _BYTE, _I16, _I32, _I64 = 1, 2, 3, 4, 5, 6
_STRUCT = 12


@dataclass(frozen=True, kw_only=True, slots=True)
class _Page:
    """One data page: where its values are in the file, and which rows they are."""

    start: int
    n_bytes: int
    crc32: int
    first_row: int
    n_rows: int


def local_pages(source: ParquetSource, columns: tuple[str, ...]) -> "FramePages | None":
    """Access to single blobs; None where whole chunks have to be read.

    That is on remote storage, where one request for a clip beats one per frame, and for columns that
    are compressed, nullable or encoded in another way than shards.parquet writes them.
    """
    if not isinstance(source.fs, LocalFileSystem) or source.num_row_groups == 0:
        return None
    schema, group = source.metadata.schema, source.metadata.row_group(0)
    for name in columns:
        index = schema.names.index(name) if name in schema.names else -1
        if index < 0 or group.column(index).path_in_schema != name:
            return None
        chunk, plain = group.column(index), {"PLAIN", "RLE"}
        if chunk.compression != "UNCOMPRESSED" or not set(chunk.encodings) <= plain:
            return None
        if schema.column(index).max_definition_level or chunk.has_dictionary_page:
            return None
    return FramePages(source)


class FramePages:
    """One open file. Not to be shared between threads."""

    def __init__(self, source: ParquetSource) -> None:
        self._source = source
        self._indices = {name: i for i, name in enumerate(source.metadata.schema.names)}
        self._pages: BoundedCache[tuple[_Page, ...]] = BoundedCache(_MAX_TABLES)
        try:
            self._file = open(source.path, "rb", buffering=0)  # noqa: SIM115 closed with this object
        except OSError as error:
            raise StorageError(f"cannot be opened: {error}", where=source.path) from error

    def blob(self, group: int, column: str, row: int) -> memoryview:
        """The bytes of one cell. Raises CorruptShardError."""
        pages = self._pages.get((group, column), lambda: self._page_table(group, column), lambda _: 1)
        page = next((p for p in pages if p.first_row <= row < p.first_row + p.n_rows), None)
        if page is None:
            raise self._damaged("no such row", group, column, row)
        payload = memoryview(self._read(page.start, page.n_bytes))
        if len(payload) != page.n_bytes or zlib.crc32(payload) != page.crc32:
            raise ChecksumError(
                "the data do not match their CRC-32",
                where=self._source.path,
                row=f"group {group}, frame {row}",
                column=column,
                fix=COPY_AGAIN,
            )
        values, position = [], 0
        while position < len(payload):  # PLAIN: four bytes of length, little endian, before each value
            end = position + 4 + int.from_bytes(payload[position : position + 4], "little")
            values.append(payload[position + 4 : end])
            position = end
        if position != len(payload) or len(values) != page.n_rows:
            raise self._damaged("a page holds other rows than its header says", group, column, row)
        return values[row - page.first_row]

    def _page_table(self, group: int, column: str) -> tuple[_Page, ...]:
        """The pages of a column chunk, found by going from header to header."""
        chunk = self._source.metadata.row_group(group).column(self._indices[column])
        position, end = chunk.data_page_offset, chunk.data_page_offset + chunk.total_compressed_size
        pages: list[_Page] = []
        n_rows = 0
        while position < end:
            try:
                header, length = _parse_struct(self._read(position, _HEADER_BYTES), 0)
                kind, n_bytes, crc32, values = header[1], header[3], header[4], header[5]
                usable = kind == _DATA_PAGE and values[2] == _PLAIN and values[1] > 0 and n_bytes >= 0
                if not usable:
                    raise ValueError("not a page of plain values")
            except (ValueError, IndexError, KeyError, TypeError) as error:
                raise self._damaged("unreadable page header", group, column, n_rows) from error
            start = position + length
            pages.append(
                _Page(
                    start=start,
                    n_bytes=n_bytes,
                    crc32=crc32 & 0xFFFFFFFF,
                    first_row=n_rows,
                    n_rows=values[1],
                )
            )
            position, n_rows = start + n_bytes, n_rows + values[1]
        if position != end or n_rows != self._source.metadata.row_group(group).num_rows:
            raise self._damaged("the pages do not fill their column chunk", group, column, n_rows)
        return tuple(pages)

    def _read(self, start: int, n_bytes: int) -> bytes:
        try:
            return os.pread(self._file.fileno(), n_bytes, start)
        except OSError as error:
            raise StorageError(f"cannot be read: {error}", where=self._source.path) from error

    def _damaged(self, problem: str, group: int, column: str, row: int) -> CorruptShardError:
        return CorruptShardError(
            problem,
            where=self._source.path,
            row=f"group {group}, frame {row}",
            column=column,
            fix=COPY_AGAIN,
        )


def _parse_struct(data: bytes, position: int) -> tuple[dict[int, Any], int]:
    """Field number -> value of a Thrift struct of integers, booleans and structs, and where it ends."""
    values: dict[int, Any] = {}
    field = 0
    while True:
        head = data[position]
        position += 1
        if head == 0:
            return values, position
        kind = head & 0x0F
        if head >> 4:
            field += head >> 4
        else:
            number, position = _varint(data, position)
            field = (number >> 1) ^ -(number & 1)
        if kind in (_TRUE, _FALSE):
            values[field] = kind == _TRUE
        elif kind == _BYTE:
            values[field], position = data[position], position + 1
        elif kind in (_I16, _I32, _I64):
            number, position = _varint(data, position)
            values[field] = (number >> 1) ^ -(number & 1)
        elif kind == _STRUCT:
            values[field], position = _parse_struct(data, position)
        else:
            raise ValueError(f"unexpected Thrift type {kind}")


def _varint(data: bytes, position: int) -> tuple[int, int]:
    number = shift = 0
    while True:
        byte = data[position]
        position += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number, position
        shift += 7
