"""The PLY container: a header, then elements of numbers and lists, as text or as bytes of either order.

What the elements mean is in `ply`.
"""

import re
import struct
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Int

from datagen.objects.errors import ObjectError
from datagen.objects.formats.number_text import numbers_of

__all__ = ["PlyDeclaration", "PlyElement", "PlyHeader", "PlyList", "PlyProperty", "read_body", "read_header"]

TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float": "f4",
    "double": "f8",
    "float32": "f4",
    "float64": "f8",
    "float16": "f2",
    "half": "f2",
}
STRUCT_CODES = {
    "i1": "b",
    "u1": "B",
    "i2": "h",
    "u2": "H",
    "i4": "i",
    "u4": "I",
    "i8": "q",
    "u8": "Q",
    "f2": "e",
    "f4": "f",
    "f8": "d",
}
FLOAT64 = np.dtype("<f8")
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
LINE = re.compile(rb"([^\r\n]*)(\r\n|\n|\r)")
BOM = b"\xef\xbb\xbf"
SHOWN_CHARS = 60
MAX_DIGITS = 18


@dataclass(frozen=True, kw_only=True)
class PlyProperty:
    """One column of an element: a number per row, or a list of them."""

    name: str
    dtype: np.dtype  # of the numbers
    length_dtype: np.dtype | None  # of a list's length; None: not a list


@dataclass(kw_only=True)
class PlyDeclaration:
    """One element as the header announces it."""

    count: int
    properties: list[PlyProperty] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class PlyHeader:
    """What stands above the numbers."""

    byte_order: str  # "<" or ">"; empty: text
    elements: dict[str, PlyDeclaration]  # in the order of the file
    comments: tuple[str, ...]  # and obj_info lines
    size: int  # bytes

    def count(self, element: str) -> int:
        """Rows of an element; 0 where the file has none of that name."""
        return self.elements[element].count if element in self.elements else 0

    def types(self, element: str) -> dict[str, np.dtype]:
        """Declared types of an element's properties by name; none where the file has no such element."""
        return (
            {prop.name: prop.dtype for prop in self.elements[element].properties}
            if element in self.elements
            else {}
        )


@dataclass(frozen=True, kw_only=True)
class PlyList:
    """One list per row, all of them end to end. Text gives float64, bytes the declared type."""

    lengths: Int[np.ndarray, " row"]
    values: np.ndarray


@dataclass(frozen=True, kw_only=True)
class PlyElement:
    """The rows of one element, by property. Text gives float64, bytes the declared type."""

    count: int
    numbers: dict[str, np.ndarray] = field(default_factory=dict)
    lists: dict[str, PlyList] = field(default_factory=dict)


def read_header(data: bytes, source: Path) -> PlyHeader:
    """The header; lines may end in LF, CRLF or CR, comments may be in any encoding."""
    at = len(BOM) if data.startswith(BOM) else 0
    line = LINE.match(data, at)
    if line is None or line[1].strip().lower() != b"ply":
        raise _refused(source, "is not a PLY file (it does not begin with the line 'ply')", "a PLY mesh")
    old_mac = line[2] == b"\r"
    byte_order: str | None = None
    elements: dict[str, PlyDeclaration] = {}
    comments: list[str] = []
    for number in range(2, len(data)):
        line = LINE.match(data, line.end())
        if line is None:
            raise _refused(source, "has no line 'end_header'", "a whole PLY file")
        text = _decoded(line[1])
        words = text.split()
        keyword = words[0].lower() if words else "comment"
        if keyword == "end_header":
            break
        if keyword in ("comment", "obj_info"):
            comments.append(text.strip()[len(keyword) :].strip())
        elif keyword == "format":
            byte_order = BYTE_ORDERS.get(words[1].lower()) if len(words) > 1 else None
        elif not _declare(elements, keyword, words):
            raise _refused(
                source,
                f"header line {number} cannot be read: {text.strip()[:SHOWN_CHARS]!r}",
                "'element NAME COUNT', 'property TYPE NAME' or 'property list TYPE TYPE NAME'",
            )
    if byte_order is None:
        raise _refused(source, "states no format that is known", f"one of {', '.join(BYTE_ORDERS)}")
    # After old Mac line ends the first byte of the body may happen to be a line feed.
    size = line.end(1) + 1 if old_mac else line.end()
    return PlyHeader(byte_order=byte_order, elements=elements, comments=tuple(comments), size=size)


def _decoded(line: bytes) -> str:
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError:
        return line.decode("latin-1")


def _declare(elements: dict[str, PlyDeclaration], keyword: str, words: list[str]) -> bool:
    """Take one element or property line in; False where it makes no sense."""
    if keyword == "element" and len(words) == 3:
        name, count = words[1].lower(), words[2]
        if name in elements or not count.isdecimal() or len(count) > MAX_DIGITS:
            return False
        elements[name] = PlyDeclaration(count=int(count))
        return True
    if keyword != "property" or not elements:
        return False
    is_list = len(words) == 5 and words[1].lower() == "list"
    types = [word.lower() for word in (words[2:4] if is_list else words[1:2])]
    if (not is_list and len(words) != 3) or not all(kind in TYPES for kind in types):
        return False
    last = elements[next(reversed(elements))]
    dtypes = [np.dtype(TYPES[kind]) for kind in types]
    length_dtype = dtypes[0] if is_list else None
    last.properties.append(PlyProperty(name=words[-1].lower(), dtype=dtypes[-1], length_dtype=length_dtype))
    return True


def read_body(data: bytes, header: PlyHeader, source: Path) -> dict[str, PlyElement]:
    """All elements, by name. ObjectError where the body is shorter or longer than the header says."""
    is_text = not header.byte_order
    # A text is laid out as bytes would be, with every number and length a float64.
    body = memoryview(data)[header.size :]
    if is_text:
        body = memoryview(numbers_of(bytes(body), source, "its numbers").tobytes())
    elements: dict[str, PlyElement] = {}
    at = 0
    for name, declared in header.elements.items():
        stored = [_stored(prop, header.byte_order) for prop in declared.properties]
        try:
            elements[name], at = _read_element(body, at, declared.count, stored)
        except (struct.error, _TooShortError) as error:
            raise _refused(
                source,
                f"is cut short: its body ends within element {name!r}",
                f"{declared.count:,} of {name!r}, as the header says",
            ) from error
        except _BadLengthError as error:
            raise _refused(
                source, f"a list of element {name!r} has {error} entries", "a whole number from 0"
            ) from error
    rest = bytes(body[at:])
    if not is_text:
        rest = rest.strip(b"\0\r\n\t ")  # padding
    if rest:
        excess = f"{len(rest) // FLOAT64.itemsize:,} numbers" if is_text else f"{len(rest):,} bytes"
        raise _refused(
            source,
            f"holds {excess} more than its header announces",
            "the counts and properties of the header to fit the body",
        )
    return elements


def _stored(prop: PlyProperty, byte_order: str) -> PlyProperty:
    """The property as the body holds it."""

    def stored(dtype: np.dtype) -> np.dtype:
        return np.dtype(byte_order + dtype.str[1:]) if byte_order else FLOAT64

    length_dtype = None if prop.length_dtype is None else stored(prop.length_dtype)
    return replace(prop, dtype=stored(prop.dtype), length_dtype=length_dtype)


class _TooShortError(Exception):
    """The body ends before its element does."""


class _BadLengthError(Exception):
    """A list is announced with a length that is no whole number."""


def _read_element(
    body: memoryview, at: int, count: int, properties: list[PlyProperty]
) -> tuple[PlyElement, int]:
    """One element from byte `at` on, and where it ends."""
    if count == 0 or not properties:
        return PlyElement(count=count), at
    least = sum((prop.length_dtype or prop.dtype).itemsize for prop in properties)
    if at + count * least > len(body):  # before anything of that size is made
        raise _TooShortError
    alike = _alike_rows(body, at, count, properties)
    return alike if alike is not None else _ragged_rows(body, at, count, properties)


def _alike_rows(
    body: memoryview, at: int, count: int, properties: list[PlyProperty]
) -> tuple[PlyElement, int] | None:
    """The element where every list is as long as that of the first row; None where it is not so."""
    offsets, lengths, width = [], [], 0
    for prop in properties:
        length = 1
        if prop.length_dtype is not None:
            length = _length(_unpacker(prop.length_dtype).unpack_from(body, at + width)[0])
            width += prop.length_dtype.itemsize
        offsets.append(width)
        lengths.append(length)
        width += length * prop.dtype.itemsize
    end = at + count * width
    if end > len(body):
        return None  # or other rows are shorter
    element = PlyElement(count=count)
    for prop, offset, length in zip(properties, offsets, lengths):
        if prop.length_dtype is None:
            column: np.ndarray = np.ndarray(count, prop.dtype, body, at + offset, (width,))
            element.numbers.setdefault(prop.name, column)
            continue
        length_at = at + offset - prop.length_dtype.itemsize
        if (np.ndarray(count, prop.length_dtype, body, length_at, (width,)) != length).any():
            return None
        table: np.ndarray = np.ndarray(
            (count, length), prop.dtype, body, at + offset, (width, prop.dtype.itemsize)
        )
        found = PlyList(lengths=np.full(count, length, dtype=np.int64), values=table.reshape(-1))
        element.lists.setdefault(prop.name, found)
    return element, end


def _ragged_rows(
    body: memoryview, at: int, count: int, properties: list[PlyProperty]
) -> tuple[PlyElement, int]:
    """The element where lists differ in length: rows are walked once, then gathered column by column."""
    lists = [prop for prop in properties if prop.length_dtype is not None]
    if not lists:
        raise _TooShortError
    starts, lengths, after, end = _walk(body, at, count, properties)
    element = PlyElement(count=count)
    segment, offset, raw = 0, 0, np.frombuffer(body, dtype=np.uint8)
    for prop in properties:
        if prop.length_dtype is None:
            element.numbers.setdefault(prop.name, _gathered(raw, after[segment] + offset, prop.dtype))
            offset += prop.dtype.itemsize
            continue
        n = lengths[segment]
        within = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n)
        places = np.repeat(starts[segment], n) + within * prop.dtype.itemsize
        found = PlyList(lengths=n, values=_gathered(raw, places, prop.dtype))
        element.lists.setdefault(prop.name, found)
        segment, offset = segment + 1, 0
    return element, end


def _walk(
    body: memoryview, at: int, count: int, properties: list[PlyProperty]
) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray], int]:
    """Per list property: where each row's list starts and how long it is; where the numbers before the
    first list and after each one stand; where the element ends."""
    leads, steps = [0], []
    for prop in properties:
        if prop.length_dtype is None:
            leads[-1] += prop.dtype.itemsize
        else:
            unpack = _unpacker(prop.length_dtype).unpack_from
            steps.append((leads[-1], unpack, prop.length_dtype.itemsize, prop.dtype.itemsize))
            leads.append(0)
    starts = np.empty((len(steps), count), dtype=np.int64)
    lengths = np.empty((len(steps), count), dtype=np.int64)
    after = np.empty((len(steps) + 1, count), dtype=np.int64)
    for row in range(count):
        after[0, row] = at
        for k, (lead, unpack, length_size, item_size) in enumerate(steps):
            length = _length(unpack(body, at + lead)[0])
            at += lead + length_size
            starts[k, row], lengths[k, row] = at, length
            at += length * item_size
            after[k + 1, row] = at
        at += leads[-1]
    if at > len(body):
        raise _TooShortError
    return list(starts), list(lengths), list(after), at


def _unpacker(dtype: np.dtype) -> struct.Struct:
    return struct.Struct((">" if dtype.byteorder == ">" else "<") + STRUCT_CODES[dtype.str[1:]])


def _length(value: int | float) -> int:
    if not 0 <= value < 2**31 or value != int(value):
        raise _BadLengthError(value)
    return int(value)


def _gathered(raw: np.ndarray, places: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """The numbers that start at these bytes."""
    if not len(places):
        return np.zeros(0, dtype=dtype)
    if int(places.max()) + dtype.itemsize > len(raw):
        raise _TooShortError
    return raw[places[:, None] + np.arange(dtype.itemsize)].view(dtype)[:, 0]


def _refused(source: Path, problem: str, expected: str) -> ObjectError:
    return ObjectError(
        source,
        problem,
        expected=expected,
        action="Copy the file again, or export the mesh again, for instance with Blender.",
    )
