"""Reads pickles of others (MANO, HTML, GraspXL) without running anything that they name.

A pickle is a program: it names globals, calls them and sets state on the results. Here the names lead
to a fixed table of inert stand-ins of this file, which only write down what they were given; code of
ours turns those notes into arrays afterwards, once every type, length and shape has been checked. The
protection is against code in a file, not against a file that merely wastes memory.
"""

import math
import pickle
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy_format
from scipy import sparse

from datagen.input_error import InputError

__all__ = ["load_restricted_npy", "load_restricted_pickle"]

_PICKLE, _NPY = "pickle", "pickled object in an .npy"
_MAX_NESTING = 40
_DTYPE = re.compile(r"[<>=|]?[biufcSUO]\d*")
_KNOWN_STARTS = (
    (b"PK\x03\x04", "the file is a zip archive"),
    (b"\x1f\x8b", "the file is a gzip archive"),
    (b"\x93NUMPY", "the file is a NumPy array (.npy)"),
    (b"<", "the file is a web page, probably the login page of the site"),
    (b"version https://git-lfs", "the file is a Git LFS pointer, not the data"),
)


class _RefusedError(Exception):
    """What a file asked for and does not get."""


def load_restricted_pickle(path: Path) -> Any:
    """The object in a pickle of Python 2 or 3: plain builtins, NumPy arrays, scipy csc or csr matrices.

    Python 2 strings are read as latin-1, chumpy objects become the array they stand for. InputError
    when the file cannot be read, is no pickle, or names any other global; no code of the file runs.
    """
    with _opened(path) as file:
        return _load(path, file)


def load_restricted_npy(path: Path) -> Any:
    """The one object in an .npy written with `np.save(path, object)`, as `np.load(path).item()` gives it.

    Restricted as `load_restricted_pickle`. InputError when the file does not hold one pickled object.
    """
    with _opened(path) as file:
        try:
            npy_format.read_magic(file)
            shape, _, dtype = npy_format.read_array_header_1_0(file)  # what np.save writes for one object
        except Exception as error:  # broken headers raise ValueError, TokenError, ...
            raise _not_loaded(path, _known_start(path) or "the .npy header cannot be read", _NPY) from error
        if dtype != np.dtype(object) or shape != ():
            raise _not_loaded(path, f"the file holds an array of {dtype} of shape {shape}", _NPY)
        held = _load(path, file)
    if not isinstance(held, np.ndarray) or held.dtype != object or held.shape != ():
        raise _not_loaded(path, f"the pickle inside holds {type(held).__name__}", _NPY)
    return held.item()


def _opened(path: Path) -> IO[bytes]:
    try:
        return path.open("rb")
    except OSError as error:
        raise InputError(
            path,
            f"the file cannot be read ({error.strerror})",
            expected="a readable file",
            action="Check the path and its permissions.",
        ) from error


def _load(path: Path, file: IO[bytes]) -> Any:
    try:
        return _finish(_RestrictedUnpickler(file).load(), {}, 0)
    except _RefusedError as error:
        raise _not_loaded(path, str(error), _PICKLE) from error
    except MemoryError as error:
        raise _not_loaded(path, "the file asks for more memory than there is", _PICKLE) from error
    except Exception as error:  # broken pickles raise nearly anything: ValueError, KeyError, IndexError, ...
        reason = str(error)[:120] or type(error).__name__
        problem = _known_start(path) or f"the file cannot be read as a pickle ({reason})"
        raise _not_loaded(path, problem, _PICKLE) from error


def _not_loaded(path: Path, problem: str, kind: str) -> InputError:
    line = "".join(part if part.isprintable() else " " for part in problem)[:300]
    expected = f"a {kind} of numbers, text, NumPy arrays and scipy matrices"
    return InputError(path, line, expected=expected, action="Download the original file again.")


def _known_start(path: Path) -> str | None:
    """What the file is when it begins like a well-known other thing."""
    with path.open("rb") as file:
        start = file.read(64).lstrip(b"\xef\xbb\xbf \t\r\n")
    if not start:
        return "the file is empty"
    return next((problem for known, problem in _KNOWN_STARTS if start.startswith(known)), None)


class _Sealed(type):
    """Class that cannot be changed: the pickle instruction BUILD may set attributes, also on classes."""

    def __setattr__(cls, name: str, value: object) -> None:
        raise _RefusedError(f"it sets the attribute {name!r} of a class")


class _WithState(metaclass=_Sealed):
    """Keeps the state that the file gives to an object, once."""

    __slots__ = ("state",)

    def __setstate__(self, state: object) -> None:
        if hasattr(self, "state"):
            raise _RefusedError(f"it sets the state of a {type(self).__name__.strip('_')} twice")
        self.state = state


# The first four are handed out as classes because pickle's NEWOBJ takes nothing else.
class _Csc(_WithState):
    """A matrix in compressed columns: data, indices, indptr and _shape (shape in new files)."""

    __slots__ = ()


class _Csr(_WithState):
    """The same in compressed rows."""

    __slots__ = ()


class _Chumpy(_WithState):
    """A variable: its value is the attribute x."""

    __slots__ = ()


class _ChumpySelect(_WithState):
    """Some values (idxs, into the flattened array) of another chumpy object a, in preferred_shape."""

    __slots__ = ()


class _Array(_WithState):
    """State: (version,) shape, dtype, Fortran order, bytes or a list of objects."""

    __slots__ = ()


class _Dtype(_WithState):
    """State: version, byte order, then what only structured types use."""

    __slots__ = ("text",)
    text: str

    def resolved(self) -> np.dtype:
        dtype = np.dtype(self.text)
        state = getattr(self, "state", (3, "|"))
        if not isinstance(state, tuple) or len(state) < 2 or state[1] not in ("<", ">", "=", "|"):
            raise _RefusedError("it describes an array type in an unknown way")
        if any(part is not None for part in state[2:5]):
            raise _RefusedError("it describes a structured array type")
        return dtype.newbyteorder(state[1])


class _Buffer(metaclass=_Sealed):
    """An array of protocol 5, or a scalar when `shape` is None."""

    __slots__ = ("dtype", "fortran", "raw", "shape")
    dtype: _Dtype
    raw: Any
    shape: Any
    fortran: bool


@dataclass(frozen=True, slots=True)
class _Named:
    """Stands for a global of the file: may be mentioned, and called where `call` says what comes of it."""

    name: str
    call: Callable[..., object] | None = None

    def __call__(self, *arguments: object) -> object:
        if self.call is None:
            raise _RefusedError(f"it calls {self.name}")
        try:
            return self.call(*arguments)
        except TypeError as error:
            raise _RefusedError(f"it calls {self.name} with the wrong arguments") from error

    def __setstate__(self, state: object) -> None:
        raise _RefusedError(f"it changes {self.name}")


_NDARRAY, _OBJECT = _Named("numpy.ndarray"), _Named("object")


def _reconstruct_array(kind: object, shape: object, _code: object) -> _Array:
    if kind != _NDARRAY or shape != (0,):
        raise _RefusedError("it makes an array in an unusual way")
    return _Array()


def _array_from_buffer(raw: object, dtype: object, shape: object, order: object) -> _Buffer:
    if not isinstance(dtype, _Dtype) or order not in ("C", "F"):
        raise _RefusedError("it makes an array in an unusual way")
    made = _Buffer()
    made.dtype, made.raw, made.shape, made.fortran = dtype, raw, shape, order == "F"
    return made


def _dtype_of(text: object, _align: object = False, _copy: object = False) -> _Dtype:
    if not isinstance(text, str) or not _DTYPE.fullmatch(text):
        raise _RefusedError(f"it uses the array type {str(text)[:40]!r}")
    made = _Dtype()
    made.text = text
    return made


def _latin1_bytes(text: object, encoding: object) -> bytes:
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise _RefusedError("it encodes text other than as latin-1")
    return text.encode("latin-1")


def _reconstructed_object(made: object, base: object, state: object) -> object:
    if not isinstance(made, _Sealed) or base != _OBJECT or state is not None:
        raise _RefusedError("it makes an object by copyreg in an unusual way")
    return made()


def _stand_ins() -> dict[tuple[str, str], object]:
    """What each global that a file may name stands for, under its names in Python 2 and 3, NumPy 1 and 2."""
    table: dict[tuple[str, str], object] = {
        ("numpy", "ndarray"): _NDARRAY,
        ("numpy", "dtype"): _Named("numpy.dtype", _dtype_of),
        ("_codecs", "encode"): _Named("_codecs.encode", _latin1_bytes),
        ("chumpy.ch", "Ch"): _Chumpy,
        ("chumpy.reordering", "Select"): _ChumpySelect,
    }
    scalar = _Named("numpy scalar", lambda dtype, raw: _array_from_buffer(raw, dtype, None, "C"))
    for core in ("numpy.core", "numpy._core"):
        table[f"{core}.multiarray", "_reconstruct"] = _Named("numpy _reconstruct", _reconstruct_array)
        table[f"{core}.multiarray", "scalar"] = scalar
        table[f"{core}.numeric", "_frombuffer"] = _Named("numpy _frombuffer", _array_from_buffer)
    for builtins in ("builtins", "__builtin__"):
        table[builtins, "object"] = _OBJECT
        table[builtins, "bytes"] = _Named("bytes", lambda: b"")  # how protocol 2 writes b""
        for plain in (set, frozenset, complex):
            table[builtins, plain.__name__] = _Named(plain.__name__, plain)
    for copyreg in ("copyreg", "copy_reg"):
        table[copyreg, "_reconstructor"] = _Named("copyreg._reconstructor", _reconstructed_object)
    for name, kind in (("csc", _Csc), ("csr", _Csr)):
        for module in (f"scipy.sparse.{name}", f"scipy.sparse._{name}"):
            table[module, f"{name}_matrix"] = table[module, f"{name}_array"] = kind
    return table


class _RestrictedUnpickler(pickle.Unpickler):
    """Every global of the file is looked up in `_stand_ins`, never imported."""

    def __init__(self, file: IO[bytes]) -> None:
        super().__init__(file, encoding="latin1")
        self._table = _stand_ins()

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self._table:
            raise _RefusedError(f"it names {module}.{name}, which no data file needs")
        return self._table[module, name]

    def persistent_load(self, pid: Any) -> Any:  # noqa: ARG002
        raise _RefusedError("it refers to an object outside the file")


def _finish(value: Any, done: dict[int, Any], depth: int) -> Any:
    """Plain data for what was read: containers are rebuilt, stand-ins turned into arrays.

    `done` holds finished objects by identity, so shared parts stay shared and are finished once.
    """
    if value is None or isinstance(value, (str, bytes, bytearray, bool, int, float, complex)):
        return value
    if depth > _MAX_NESTING:
        raise _RefusedError(f"it nests more than {_MAX_NESTING} levels, or contains itself")
    if id(value) not in done:
        # The finished object is kept together with the read one, whose id must not be reused.
        done[id(value)] = (value, _finished(value, lambda part: _finish(part, done, depth + 1)))
    return done[id(value)][1]


def _finished(value: Any, finish: Callable[[Any], Any]) -> Any:
    match value:
        case dict():
            return {finish(key): finish(part) for key, part in value.items()}
        case list() | tuple() | set() | frozenset():
            return type(value)(finish(part) for part in value)
        case _Array():
            return _array(value, finish)
        case _Buffer(shape=None):
            return _array_of_bytes(value.raw, value.dtype, (), False)[()]
        case _Buffer():
            return _array_of_bytes(value.raw, value.dtype, value.shape, value.fortran)
        case _Dtype():
            return value.resolved()
        case _Csc() | _Csr():
            return _matrix(value, finish)
        case _Chumpy():
            return _as_array(finish(_attribute(value, "x")), "x of a chumpy variable")
        case _ChumpySelect():
            return _selected(value, finish)
    raise _RefusedError(
        f"it uses {value.name if isinstance(value, _Named) else type(value).__name__} as data"
    )


def _array(value: _Array, finish: Callable[[Any], Any]) -> Any:
    state = getattr(value, "state", None)
    if not isinstance(state, tuple) or len(state) not in (4, 5) or not isinstance(state[-3], _Dtype):
        raise _RefusedError("it describes an array in an unknown way")
    shape, dtype, fortran, raw = state[-4:]
    if dtype.resolved() != np.dtype(object):
        return _array_of_bytes(raw, dtype, shape, bool(fortran))
    if not isinstance(raw, list) or len(raw) != _size(shape):
        raise _RefusedError(f"an array of objects of shape {shape} does not have as many entries")
    array = np.empty(len(raw), dtype=object)
    for i, part in enumerate(raw):
        array[i] = finish(part)
    return array.reshape(shape, order="F" if fortran else "C")


def _array_of_bytes(raw: Any, dtype: _Dtype, shape: Any, fortran: bool) -> Any:
    kind = dtype.resolved()
    if isinstance(raw, str):  # bytes of Python 2
        raw = raw.encode("latin-1")
    if kind.hasobject or kind.itemsize == 0 or not isinstance(raw, (bytes, bytearray, memoryview)):
        raise _RefusedError(f"an array of {kind} is not given by its bytes")
    n_bytes = _size(shape) * kind.itemsize
    if len(raw) != n_bytes:
        raise _RefusedError(
            f"an array of {kind} and shape {shape} needs {n_bytes} bytes, found {len(raw)}"[:200]
        )
    return np.frombuffer(raw, dtype=kind).reshape(shape, order="F" if fortran else "C")


def _size(shape: Any) -> int:
    if not isinstance(shape, tuple) or not all(type(n) is int and n >= 0 for n in shape):
        raise _RefusedError(f"{str(shape)[:60]} is no shape of an array")
    return math.prod(shape)


def _matrix(value: _Csc | _Csr, finish: Callable[[Any], Any]) -> Any:
    data, indices, indptr = (
        _as_array(finish(_attribute(value, key)), key) for key in ("data", "indices", "indptr")
    )
    shape = _attribute(value, "_shape", "shape")
    if len(shape) != 2 or _size(shape) < 0:
        raise _RefusedError(f"a sparse matrix has the shape {str(shape)[:60]}")
    kind = sparse.csc_matrix if isinstance(value, _Csc) else sparse.csr_matrix
    matrix = kind((data, indices, indptr), shape=shape)
    matrix.check_format(full_check=True)
    return matrix


def _selected(value: _ChumpySelect, finish: Callable[[Any], Any]) -> Any:
    source = _as_array(finish(_attribute(value, "a")), "a of a chumpy selection").reshape(-1)
    index = _as_array(finish(_attribute(value, "idxs")), "idxs of a chumpy selection")
    if index.dtype.kind not in "iu" or (index.size and not 0 <= index.min() <= index.max() < source.size):
        raise _RefusedError("a chumpy selection points outside its array")
    stated = isinstance(value.state, dict) and "preferred_shape" in value.state
    shape = finish(_attribute(value, "preferred_shape")) if stated else index.shape
    if _size(shape) != index.size:
        raise _RefusedError(f"a chumpy selection of {index.size} values has the shape {str(shape)[:60]}")
    return source[index.reshape(-1)].reshape(shape)


def _attribute(value: _WithState, *names: str) -> Any:
    state = getattr(value, "state", None)
    if isinstance(state, dict):
        for name in names:
            if name in state:
                return state[name]
    raise _RefusedError(f"a {type(value).__name__.strip('_')} object lacks {names[0]}")


def _as_array(value: Any, what: str) -> np.ndarray:
    if not isinstance(value, np.ndarray) or value.dtype == object:
        raise _RefusedError(f"{what} is no array of numbers")
    return value
