"""Parquet files of a shard: how they are written, and read so that no damage passes unnoticed.

One row group per clip (or per object); blobs uncompressed, numbers zstd; page checksums and
page index on. Page checksums leave page headers and the footer open: flipping every bit of the
headers of a small file gave silently wrong numbers six times. So shard.json also has the SHA-256
of the footer and a CRC-32 per column chunk, and both are checked before Arrow sees the bytes.
"""

import bisect
import hashlib
import io
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import fsspec
import pyarrow as pa
import pyarrow.parquet as pq
from fsspec.implementations.local import LocalFileSystem

from shards.columns import arrow_schema, columns_of
from shards.errors import (
    ChecksumError,
    CorruptShardError,
    IncompleteShardError,
    MissingColumnError,
    StorageError,
    TruncatedError,
)
from shards.schema import CONVENTIONS, SCHEMA_VERSION
from shards.storage.records import FileRecord

__all__ = ["COPY_AGAIN", "ParquetSource", "file_metadata", "file_record", "local_source", "parquet_writer"]

COPY_AGAIN = "copy the file again, or delete the shard and make it again"

_TAIL = 8  # the footer's length (4 bytes, little endian) and the magic word
_BLOCK = 1 << 20


def file_metadata(**extra: str) -> dict[str, str]:
    """Key-value metadata of every file."""
    return {"schema_version": SCHEMA_VERSION, "conventions": CONVENTIONS, **extra}


def parquet_writer(path: Path, row_type: type, metadata: dict[str, str]) -> pq.ParquetWriter:
    """A writer with the settings of the format; one call of write_table is one row group."""
    columns = columns_of(row_type)
    leaf = {c.name: c.name + ".list.element" * len(c.shape) for c in columns}
    return pq.ParquetWriter(
        path,
        arrow_schema(row_type, metadata),
        compression={leaf[c.name]: "NONE" if c.is_blob else "ZSTD" for c in columns},
        use_dictionary=False,
        write_statistics=[c.name for c in columns if not c.shape and not c.is_blob],
        write_page_index=True,
        write_page_checksum=True,
        write_batch_size=1,  # with small pages: a blob has its own page, so one frame can be fetched
        data_page_size=1 << 16,
    )


def file_record(path: Path) -> FileRecord:
    """Size, row count and checksums of a finished local file, read back from the disk."""
    n_bytes = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(0, n_bytes - _TAIL))
        footer_bytes = min(n_bytes, int.from_bytes(file.read(4), "little") + _TAIL)
        file.seek(n_bytes - footer_bytes)
        footer = file.read()
        metadata = pq.read_metadata(pa.BufferReader(footer))
        file.seek(0)
        digest = hashlib.sha256()
        while block := file.read(_BLOCK):
            digest.update(block)
        crcs = []
        for group in range(metadata.num_row_groups):
            for start, size in _chunk_ranges(metadata, group, range(metadata.num_columns)):
                file.seek(start)
                crcs.append(zlib.crc32(file.read(size)))
    return FileRecord(
        n_bytes=n_bytes,
        sha256=digest.hexdigest(),
        rows=metadata.num_rows,
        footer_bytes=footer_bytes,
        footer_sha256=hashlib.sha256(footer).hexdigest(),
        chunk_crc32="".join(f"{crc:08x}" for crc in crcs),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class ParquetSource:
    """One Parquet file at any fsspec location, with the record of what it must contain."""

    fs: fsspec.AbstractFileSystem
    path: str
    record: FileRecord

    @cached_property
    def metadata(self) -> pq.FileMetaData:
        """The footer, once size and footer are those recorded.

        Raises CorruptShardError, IncompleteShardError, StorageError.
        """
        self._check_size()
        start = self.record.n_bytes - self.record.footer_bytes
        (footer,) = self._fetch([(start, self.record.footer_bytes)])
        if hashlib.sha256(footer).hexdigest() != self.record.footer_sha256:
            raise ChecksumError("the footer does not match its SHA-256", where=self.path, fix=COPY_AGAIN)
        return pq.read_metadata(pa.BufferReader(footer))

    @cached_property
    def schema(self) -> pa.Schema:
        """The Arrow schema in the file."""
        return self.metadata.schema.to_arrow_schema()

    def check_columns(self, row_type: type) -> None:
        """MissingColumnError unless every column of the schema is there with its type."""
        for c in columns_of(row_type):
            if c.name not in self.schema.names:
                raise MissingColumnError("a column of the schema is missing", where=self.path, column=c.name)
            found = self.schema.field(c.name).type
            if found != c.arrow_type:
                raise MissingColumnError(
                    "another type", where=self.path, column=c.name, expected=c.arrow_type, found=found
                )

    @property
    def num_row_groups(self) -> int:
        return int(self.metadata.num_row_groups)

    def read_row_group(self, group: int, columns: Sequence[str] | None = None) -> pa.Table:
        """One row group; only the named columns are fetched (None: all).

        Raises MissingColumnError, CorruptShardError.
        """
        present = self.schema.names
        for name in columns or ():
            if name not in present:
                raise MissingColumnError("no such column", where=self.path, column=name, found=present)
        chunks = self._checked_chunks(group, present if columns is None else columns)
        try:
            parquet = pq.ParquetFile(
                pa.PythonFile(_SparseFile(chunks, self.record.n_bytes), mode="r"),
                metadata=self.metadata,
                pre_buffer=False,
                page_checksum_verification=True,
            )
            table = parquet.read_row_group(group, columns=columns, use_threads=False)
        except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
            message = str(error).split("\n")[0]
            row = f"group {group}"
            raise CorruptShardError(
                f"unreadable: {message}", where=self.path, row=row, fix=COPY_AGAIN
            ) from error
        return table

    def row_groups(self) -> Iterator[pa.Table]:
        """Every row group with all columns, one at a time."""
        return (self.read_row_group(group) for group in range(self.num_row_groups))

    def _checked_chunks(self, group: int, columns: Iterable[str]) -> dict[int, bytes]:
        """Start -> bytes of the column chunks, after comparing their CRC-32."""
        wanted, row_group, n_columns = set(columns), self.metadata.row_group(group), self.metadata.num_columns
        names = [row_group.column(i).path_in_schema.split(".")[0] for i in range(n_columns)]
        indices = [i for i, name in enumerate(names) if name in wanted]
        ranges = list(_chunk_ranges(self.metadata, group, indices))
        chunks = _split_chunks(self._fetch(_merged(ranges)), ranges)
        for i, data in zip(indices, chunks):
            position = 8 * (group * n_columns + i)
            if f"{zlib.crc32(data):08x}" != self.record.chunk_crc32[position : position + 8]:
                raise ChecksumError(
                    "the data do not match their CRC-32",
                    where=self.path,
                    row=f"group {group}",
                    column=names[i],
                    fix=COPY_AGAIN,
                )
        return {start: data for (start, _), data in zip(ranges, chunks)}

    def _check_size(self) -> None:
        with self._storage_errors():
            n_bytes = self.fs.size(self.path)
        if n_bytes is not None and n_bytes != self.record.n_bytes:  # None: the server does not say
            raise TruncatedError(
                "wrong size", where=self.path, expected=self.record.n_bytes, found=n_bytes, fix=COPY_AGAIN
            )

    def _fetch(self, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
        starts, ends = [start for start, _ in ranges], [start + size for start, size in ranges]
        with self._storage_errors():
            parts = self.fs.cat_ranges([self.path] * len(ranges), starts, ends, on_error="raise")
        for (start, size), part in zip(ranges, parts):
            if len(part) > size:  # the whole file, whatever was asked for
                raise StorageError(
                    "the server does not answer range requests",
                    where=self.path,
                    expected=f"{size} bytes from byte {start}",
                    found=f"{len(part)} bytes",
                    fix="download the dataset, or use a server that does",
                )
            if len(part) != size:
                found = f"{start + len(part)} bytes or fewer"
                raise TruncatedError(
                    "too short",
                    where=self.path,
                    expected=f"{self.record.n_bytes} bytes",
                    found=found,
                    fix=COPY_AGAIN,
                )
        return [bytes(part) for part in parts]

    @contextmanager
    def _storage_errors(self) -> Iterator[None]:
        try:
            yield
        except FileNotFoundError as error:
            raise IncompleteShardError("the file is missing", where=self.path, fix=COPY_AGAIN) from error
        except OSError as error:
            raise StorageError(f"cannot be read: {error}", where=self.path) from error


def local_source(path: Path, record: FileRecord) -> ParquetSource:
    """A source on the local disk."""
    return ParquetSource(fs=LocalFileSystem(), path=str(path), record=record)


def _chunk_ranges(metadata: pq.FileMetaData, group: int, indices: Iterable[int]) -> Iterator[tuple[int, int]]:
    """(start, size) of column chunks in the file."""
    row_group = metadata.row_group(group)
    for i in indices:
        chunk = row_group.column(i)
        yield chunk.data_page_offset, chunk.total_compressed_size  # there are no dictionary pages


def _merged(ranges: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Neighbouring ranges joined, so that they cost one request."""
    merged: list[tuple[int, int]] = []
    for start, size in ranges:
        if merged and sum(merged[-1]) == start:
            merged[-1] = (merged[-1][0], merged[-1][1] + size)
        else:
            merged.append((start, size))
    return merged


def _split_chunks(parts: Sequence[bytes], ranges: Sequence[tuple[int, int]]) -> list[bytes]:
    """Undo `_merged`: both run through the same bytes in the same order."""
    joined = io.BytesIO(b"".join(parts))
    return [joined.read(size) for _, size in ranges]


class _SparseFile(io.RawIOBase):
    """A file of which only some chunks are there; Arrow reads no others."""

    def __init__(self, chunks: dict[int, bytes], n_bytes: int) -> None:
        self._starts = sorted(chunks)
        self._chunks = chunks
        self._n_bytes = n_bytes
        self._position = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._position

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._n_bytes}[whence]
        self._position = base + offset
        return self._position

    def read(self, size: int = -1) -> bytes:
        index = bisect.bisect_right(self._starts, self._position) - 1
        start = self._starts[index] if index >= 0 else 0
        chunk = self._chunks.get(start, b"") if index >= 0 else b""
        offset = self._position - start
        data = chunk[offset:] if size < 0 else chunk[offset : offset + size]
        if 0 <= size != len(data):
            raise OSError(f"bytes {self._position}..{self._position + size} were not fetched")
        self._position += len(data)
        return data
