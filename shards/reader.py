"""Read a dataset from a folder or any fsspec URL: only finished shards, only the columns asked for.

Everything is verified on the way: each JSON record by its own hash, each Parquet footer by the
hash and each column chunk by the CRC in shard.json. Damage raises a ShardError, never wrong data.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import fsspec
import numpy as np
import pyarrow as pa

from shards.array_types import UInt8
from shards.columns import arrow_schema, column_values, columns_of, rows_from_table
from shards.errors import (
    CorruptShardError,
    DatasetNotFoundError,
    ImageError,
    MissingColumnError,
    StorageError,
)
from shards.schema import ROW_TYPES, ClipRow, FrameRow, ObjectRow
from shards.splits import SplitRule
from shards.storage.images import Geometry, Masks, decode_geometry, decode_masks, decode_rgb
from shards.storage.parquet import COPY_AGAIN, ParquetSource
from shards.storage.records import DatasetRecord, ShardRecord, parse_record

__all__ = [
    "ColumnTable",
    "Dataset",
    "Frame",
    "Frames",
    "Shard",
    "find_clip",
    "open_dataset",
    "open_shard",
    "open_shards",
]

_Image = TypeVar("_Image")  # RGB, masks or geometry of one frame


class ColumnTable:
    """Some columns of some rows, as arrays. `table["K"]` has shape (row, 3, 3).

    Scalars of type text or bytes come as a list, columns of varying length as a list of arrays.
    A column that was not read raises MissingColumnError.
    """

    def __init__(self, arrow: pa.Table, row_type: type, *, where: str) -> None:
        self.arrow = arrow
        self.where = where
        self._columns = {c.name: c for c in columns_of(row_type)}

    def __len__(self) -> int:
        return int(self.arrow.num_rows)

    def __getitem__(self, name: str) -> Any:
        if name not in self.arrow.column_names:
            known = name in self._columns
            problem = "this column was not read" if known else "no such column"
            fix = f"add '{name}' to columns=[...]" if known else "see the tables in shards/README.md"
            raise MissingColumnError(
                problem, where=self.where, column=name, found=self.arrow.column_names, fix=fix
            )
        column = self._columns[name]
        values = column_values(self.arrow[name], column)
        is_number = not column.shape and column.dtype not in ("string", "binary")
        return np.array(values, column.dtype) if is_number else values


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """One frame, decoded."""

    row: FrameRow
    rgb: UInt8[np.ndarray, "height width 3"]
    masks: Masks
    geometry: Geometry


class Frames(ColumnTable):
    """Frames of one clip in time order; images are decoded when asked for, `index` is the frame."""

    def __init__(self, arrow: pa.Table, *, where: str) -> None:
        super().__init__(arrow, FrameRow, where=where)

    def rgb(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        return self._decoded("rgb", index, decode_rgb)

    def masks(self, index: int) -> Masks:
        return self._decoded("masks", index, decode_masks)

    def geometry(self, index: int) -> Geometry:
        return self._decoded("geometry", index, decode_geometry)

    def frame(self, index: int) -> Frame:
        """Everything about one frame; needs all columns."""
        for field in fields(FrameRow):
            if field.name not in self.arrow.column_names:
                self[field.name]  # raises
        (row,) = rows_from_table(self.arrow.slice(index, 1), FrameRow, where=self.where)
        return Frame(row=row, rgb=self.rgb(index), masks=self.masks(index), geometry=self.geometry(index))

    def _decoded(self, column: str, index: int, decode: Callable[[bytes], _Image]) -> _Image:
        if column not in self.arrow.column_names:
            self[column]  # raises
        try:
            return decode(self.arrow[column][index].as_py())
        except ImageError as error:
            raise ImageError(str(error), where=self.where, row=f"frame {index}", column=column) from error


@dataclass(frozen=True, kw_only=True, eq=False)
class Shard:
    """One finished shard. Can be pickled to other processes; holds no open file."""

    fs: fsspec.AbstractFileSystem
    path: str
    record: ShardRecord

    def clips(self) -> list[ClipRow]:
        """All clips, in file order."""
        return self._rows("clips", ClipRow)

    def objects(self) -> list[ObjectRow]:
        """All objects with meshes and samples; `read_objects` reads single columns."""
        return self._rows("objects", ObjectRow)

    def read_split_rule(self) -> SplitRule | None:
        """The rule of the dataset that the shard lies in; None where it lies alone."""
        root = self.path.rpartition("/shards/")[0]
        where = f"{root}/dataset.json"
        if not root or not self.fs.exists(where):
            return None
        return parse_record(_read(self.fs, where), DatasetRecord, where=where).split_rule

    def read_clips(self, columns: Sequence[str]) -> ColumnTable:
        """The named columns of all clips."""
        return self._table("clips", columns)

    def read_objects(self, columns: Sequence[str]) -> ColumnTable:
        """The named columns of all objects."""
        return self._table("objects", columns)

    def has_object(self, object_uid: str) -> bool:
        """Whether objects.parquet describes the object."""
        return object_uid in self._object_places

    def read_object(self, object_uid: str, columns: Sequence[str]) -> ColumnTable:
        """The named columns of one object, a table of one row. DatasetNotFoundError when it is not there."""
        source = self._sources["objects"]
        if not self.has_object(object_uid):
            raise DatasetNotFoundError("no such object", where=source.path, found=object_uid)
        group, row = self._object_places[object_uid]
        table = source.read_row_group(group, columns).slice(row, 1)
        return ColumnTable(table, ObjectRow, where=f"{source.path}, object {object_uid}")

    def read_clip(self, clip_id: str) -> ClipRow:
        """One clip. DatasetNotFoundError when it is not there."""
        find_clip([self], clip_id, where=self.path)
        return next(clip for clip in self.clips() if clip.clip_id == clip_id)

    def read_frames(self, clip_id: str, columns: Sequence[str] | None = None) -> Frames:
        """The frames of one clip; only `columns` are fetched (None: all). DatasetNotFoundError."""
        find_clip([self], clip_id, where=self.path)
        group = self.record.clip_ids.index(clip_id)
        source = self._sources["frames"]
        where = f"{source.path}, clip {clip_id}"
        wanted = None if columns is None else list(dict.fromkeys(["clip_id", *columns]))
        table = source.read_row_group(group, wanted)
        if table["clip_id"].unique().to_pylist() != [clip_id]:
            raise CorruptShardError(
                "row group of another clip", where=where, row=f"group {group}", fix=COPY_AGAIN
            )
        return Frames(table, where=where)

    def source(self, name: str) -> ParquetSource:
        """The file behind "objects", "clips" or "frames"."""
        return self._sources[name]

    def _rows(self, name: str, row_type: type) -> list[Any]:
        table = self._table(name, None)
        return rows_from_table(table.arrow, row_type, where=table.where)

    def _table(self, name: str, columns: Sequence[str] | None) -> ColumnTable:
        source = self._sources[name]
        groups = [source.read_row_group(i, columns) for i in range(source.num_row_groups)]
        empty = arrow_schema(ROW_TYPES[name]).empty_table()
        return ColumnTable(pa.concat_tables(groups) if groups else empty, ROW_TYPES[name], where=source.path)

    @cached_property
    def _object_places(self) -> dict[str, tuple[int, int]]:
        """Row group of each object and row within it."""
        source = self._sources["objects"]
        return {
            uid: (group, row)
            for group in range(source.num_row_groups)
            for row, uid in enumerate(source.read_row_group(group, ["object_uid"])["object_uid"].to_pylist())
        }

    @cached_property
    def _sources(self) -> dict[str, ParquetSource]:
        return {
            name: ParquetSource(
                fs=self.fs, path=f"{self.path}/{name}.parquet", record=self.record.files[f"{name}.parquet"]
            )
            for name in ROW_TYPES
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class Dataset:
    """A dataset at any fsspec location."""

    fs: fsspec.AbstractFileSystem
    path: str
    record: DatasetRecord
    shards: tuple[Shard, ...]  # finished ones, in order

    def clips(self) -> Iterator[ClipRow]:
        """All clips of all finished shards."""
        for shard in self.shards:
            yield from shard.clips()

    def objects(self) -> Iterator[ObjectRow]:
        """All objects, each once."""
        seen: set[str] = set()
        for shard in self.shards:
            for row in shard.objects():
                if row.object_uid not in seen:
                    seen.add(row.object_uid)
                    yield row

    def read_frames(self, clip_id: str, columns: Sequence[str] | None = None) -> Frames:
        """The frames of one clip; only `columns` are fetched (None: all). DatasetNotFoundError."""
        shard = self._shard_of_clip.get(clip_id) or find_clip(self.shards, clip_id, where=self.path)
        return shard.read_frames(clip_id, columns)

    @cached_property
    def _shard_of_clip(self) -> dict[str, Shard]:
        return {clip_id: shard for shard in self.shards for clip_id in shard.record.clip_ids}


def open_dataset(url: str | Path, *, shards: Sequence[int] | None = None) -> Dataset:
    """Open a dataset folder, local or remote ("s3://...", "https://...", "memory://...").

    `shards` names the shards to open, needed where a server cannot list folders; None takes every
    finished one. Raises DatasetNotFoundError, SchemaVersionError, CorruptShardError.
    """
    fs, root = _located(url)
    record = parse_record(_read(fs, f"{root}/dataset.json"), DatasetRecord, where=f"{url}/dataset.json")
    if shards is None:
        found = sorted(str(path) for path in fs.glob(f"{root}/shards/shard-*/shard.json"))
        paths = [path.removesuffix("/shard.json") for path in found]
    else:
        paths = [f"{root}/shards/shard-{shard:05d}" for shard in shards]
    return Dataset(fs=fs, path=str(url), record=record, shards=tuple(_shard(fs, path) for path in paths))


def open_shard(url: str | Path) -> Shard:
    """Open one shard folder by itself."""
    fs, path = _located(url)
    return _shard(fs, path)


def open_shards(url: str | Path) -> tuple[Shard, ...]:
    """The finished shards of a dataset, or the one shard that `url` is. Local or remote, as `open_dataset`.

    DatasetNotFoundError when it is neither, or when no shard is finished.
    """
    fs, path = _located(url)
    if fs.exists(f"{path}/shard.json"):
        return (_shard(fs, path),)
    shards = open_dataset(url).shards
    if not shards:
        raise DatasetNotFoundError(
            "no finished shard",
            where=str(url),
            expected="at least one shards/shard-*/shard.json",
            fix="render one (make render SHARD=0), or name shard folders where a server lists nothing",
        )
    return shards


def find_clip(shards: Sequence[Shard], clip_id: str, *, where: str) -> Shard:
    """The shard that holds the clip. DatasetNotFoundError, which names the closest clip of `where`."""
    for shard in shards:
        if clip_id in shard.record.clip_ids:
            return shard
    known = [known_id for shard in shards for known_id in shard.record.clip_ids]
    close = get_close_matches(clip_id, known, n=1) or known[:1]
    raise DatasetNotFoundError(
        "no such clip",
        where=where,
        expected=f"one of its {len(known)} clips",
        found=clip_id,
        fix=f"is it '{close[0]}'?" if close else "",
    )


def _located(url: str | Path) -> tuple[fsspec.AbstractFileSystem, str]:
    try:
        fs, path = fsspec.core.url_to_fs(str(url))
    except (ImportError, ValueError) as error:  # the library of a protocol is missing; an unknown protocol
        raise StorageError(
            f"cannot be opened: {error}",
            where=str(url),
            fix="install what its kind of address needs (http and https: pip install aiohttp), or correct it",
        ) from error
    return fs, path.rstrip("/")


def _shard(fs: fsspec.AbstractFileSystem, path: str) -> Shard:
    where = f"{path}/shard.json"
    return Shard(fs=fs, path=path, record=parse_record(_read(fs, where), ShardRecord, where=where))


def _read(fs: fsspec.AbstractFileSystem, path: str) -> bytes:
    try:
        return bytes(fs.cat_file(path))
    except (FileNotFoundError, NotADirectoryError) as error:
        fix = "check the address; a shard without its shard.json is unfinished"
        raise DatasetNotFoundError("no such file", where=path, fix=fix) from error
    except OSError as error:
        raise StorageError(f"cannot be read: {error}", where=path) from error
