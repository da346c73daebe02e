"""What a column is: name, dtype, shape, unit, frame, meaning; and its way to Arrow and back.

A table's columns are the fields of one frozen dataclass, described with `column(...)`.
The Arrow schema, the checks on rows and the README table all come from that description.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa

from shards.errors import RowError

__all__ = [
    "Column",
    "arrow_schema",
    "column",
    "columns_of",
    "markdown_table",
    "rows_from_table",
    "table_from_rows",
]

Row = TypeVar("Row")

_ARROW = {
    "string": pa.string(),
    "binary": pa.binary(),
    "bool": pa.bool_(),
    "uint8": pa.uint8(),
    "int32": pa.int32(),
    "int64": pa.int64(),
    "float32": pa.float32(),
    "float64": pa.float64(),
}


@dataclass(frozen=True, kw_only=True)
class Column:
    """One column. `shape` is () for a scalar; only its first entry may be a name (any length)."""

    name: str
    dtype: str
    shape: tuple[int | str, ...]
    unit: str
    frame: str
    meaning: str
    choices: tuple[str, ...]
    nullable: bool
    allow_nan: bool

    @property
    def is_blob(self) -> bool:
        """Encoded files: stored uncompressed, because they are compressed already."""
        return self.dtype == "binary"

    @property
    def arrow_type(self) -> pa.DataType:
        arrow_type = _ARROW[self.dtype]
        for size in reversed(self.shape):
            element = pa.field("element", arrow_type, nullable=False)
            arrow_type = pa.list_(element) if isinstance(size, str) else pa.list_(element, size)
        return arrow_type


def column(
    dtype: str,
    *shape: int | str,
    meaning: str,
    unit: str = "",
    frame: str = "",
    choices: tuple[str, ...] = (),
    nullable: bool = False,
    allow_nan: bool = False,
) -> Any:
    """A dataclass field that is a column; see `Column` for the arguments."""
    keys = {"dtype": dtype, "shape": shape, "unit": unit, "frame": frame, "meaning": meaning}
    return field(metadata={**keys, "choices": choices, "nullable": nullable, "allow_nan": allow_nan})


def columns_of(row_type: type) -> tuple[Column, ...]:
    """The columns of a row dataclass, in file order."""
    return tuple(Column(name=f.name, **f.metadata) for f in fields(row_type))


def arrow_schema(row_type: type, file_metadata: dict[str, str] | None = None) -> pa.Schema:
    """Arrow schema; unit, frame and meaning travel in each field's metadata."""
    arrow_fields = [
        pa.field(
            c.name,
            c.arrow_type,
            nullable=c.nullable,
            metadata={"unit": c.unit, "frame": c.frame, "meaning": c.meaning},
        )
        for c in columns_of(row_type)
    ]
    return pa.schema(arrow_fields, metadata=file_metadata)


def table_from_rows(rows: Sequence[Any], row_type: type, *, where: str) -> pa.Table:
    """Check every value against its column and build the Arrow table. `where` names the file in errors."""
    columns = columns_of(row_type)
    values = {
        c.name: [_checked(getattr(row, c.name), c, where=where, row=i) for i, row in enumerate(rows)]
        for c in columns
    }
    _check_named_lengths(columns, values, len(rows), where=where)
    arrays = [_to_arrow(values[c.name], c) for c in columns]
    return pa.Table.from_arrays(arrays, schema=arrow_schema(row_type))


def rows_from_table(table: pa.Table, row_type: type[Row], *, where: str) -> list[Row]:
    """The rows of a table that has all columns of `row_type`; arrays have the column's dtype and shape."""
    columns = columns_of(row_type)
    values = {c.name: column_values(table[c.name], c) for c in columns}
    _check_named_lengths(columns, values, table.num_rows, where=where)
    return [row_type(**{name: column[i] for name, column in values.items()}) for i in range(table.num_rows)]


def column_values(chunked: pa.ChunkedArray, c: Column) -> list[Any] | np.ndarray:
    """Python values of a scalar column; one array (row, *shape), or a list of arrays when lengths vary."""
    if not c.shape:
        scalars: list[Any] = chunked.to_pylist()
        return scalars
    array = chunked.combine_chunks()
    lengths = None
    if isinstance(c.shape[0], str):
        lengths = np.diff(array.offsets.to_numpy())
    flat = array.flatten()
    for _ in c.shape[1:]:
        flat = flat.flatten()
    values: np.ndarray = flat.to_numpy(zero_copy_only=False)
    if lengths is None:
        return values.reshape(len(array), *c.shape)
    items = values.reshape(int(lengths.sum()), *c.shape[1:])
    return np.split(items, np.cumsum(lengths)[:-1]) if len(lengths) else []


def markdown_table(row_type: type) -> str:
    """The README's table of one file."""
    lines = ["| column | type | unit | frame | meaning |", "|---|---|---|---|---|"]
    for c in columns_of(row_type):
        shape = f"[{', '.join(map(str, c.shape))}]" if c.shape else ""
        null = ", may be null" if c.nullable else ""
        choices = f" One of: {', '.join(c.choices)}." if c.choices else ""
        lines.append(f"| `{c.name}` | {c.dtype}{shape}{null} | {c.unit} | {c.frame} | {c.meaning}{choices} |")
    return "\n".join(lines)


def _check_named_lengths(
    columns: Sequence[Column], values: Mapping[str, Any], n_rows: int, *, where: str
) -> None:
    """Columns whose first axis has the same name have the same length in each row."""
    for row in range(n_rows):
        lengths: dict[str, int] = {}
        for c in columns:
            if c.shape and isinstance(c.shape[0], str):
                found = len(values[c.name][row])
                expected = lengths.setdefault(c.shape[0], found)
                if found != expected:
                    problem = f"another number of '{c.shape[0]}' than the columns before"
                    raise RowError(
                        problem, where=where, row=row, column=c.name, expected=expected, found=found
                    )


def _checked(value: Any, c: Column, *, where: str, row: int) -> Any:
    """`value` in the column's own dtype, or a RowError."""
    if value is None and c.nullable:
        return None
    if c.dtype in ("string", "binary"):
        kind = str if c.dtype == "string" else bytes
        if not isinstance(value, kind):
            raise RowError(
                "wrong type",
                where=where,
                row=row,
                column=c.name,
                expected=c.dtype,
                found=type(value).__name__,
            )
        if c.choices and value not in c.choices:
            raise RowError(
                "unknown value", where=where, row=row, column=c.name, expected=c.choices, found=repr(value)
            )
        return value
    return _checked_numbers(value, c, where=where, row=row)


def _checked_numbers(value: Any, c: Column, *, where: str, row: int) -> Any:
    array = np.asarray(value)
    fits_shape = array.ndim == len(c.shape) and all(
        isinstance(want, str) or want == have for want, have in zip(c.shape, array.shape)
    )
    if not fits_shape:
        raise RowError(
            "wrong shape", where=where, row=row, column=c.name, expected=c.shape, found=array.shape
        )
    target = np.dtype(c.dtype)
    same_kind = target.kind == array.dtype.kind or (target.kind in "iu" and array.dtype.kind in "iu")
    if not same_kind and not (target.kind == "f" and array.dtype.kind in "iu") and array.size:
        raise RowError("wrong dtype", where=where, row=row, column=c.name, expected=target, found=array.dtype)
    if target.kind in "iu" and array.size:
        limits = np.iinfo(target)
        if array.min() < limits.min or array.max() > limits.max:
            found = f"{array.min()}..{array.max()}"
            raise RowError("out of range", where=where, row=row, column=c.name, expected=target, found=found)
    with np.errstate(over="ignore"):  # becomes infinite and is refused below
        converted = array.astype(target)
    if target.kind == "f":
        bad = np.isinf(converted) if c.allow_nan else ~np.isfinite(converted)
        if np.any(bad):
            found = f"{np.count_nonzero(bad)} of {bad.size} values"
            raise RowError("not a finite number", where=where, row=row, column=c.name, found=found)
    return converted.item() if not c.shape else converted


def _to_arrow(values: list[Any], c: Column) -> pa.Array:
    if not c.shape:
        return pa.array(values, type=c.arrow_type)
    flat = [np.ascontiguousarray(v).reshape(-1) for v in values]
    numbers = np.concatenate(flat) if flat else np.zeros(0, c.dtype)
    array = pa.array(numbers, type=_ARROW[c.dtype])
    list_types = [c.arrow_type]
    for _ in c.shape[1:]:
        list_types.append(list_types[-1].value_type)
    for list_type in reversed(list_types):
        if pa.types.is_fixed_size_list(list_type):
            array = pa.FixedSizeListArray.from_arrays(array, type=list_type)
        else:
            offsets = np.concatenate([[0], np.cumsum([len(v) for v in values])]).astype(np.int32)
            array = pa.ListArray.from_arrays(pa.array(offsets), array, type=list_type)
    return array
