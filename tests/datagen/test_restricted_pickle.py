"""Pickles of others: what data files hold is read exactly, and nothing in a file is ever run."""

import builtins
import contextlib
import copyreg
import io
import os
import pickle
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from datagen import restricted_pickle
from datagen.input_error import InputError
from datagen.restricted_pickle import load_restricted_npy, load_restricted_pickle

PROTOCOLS = range(pickle.HIGHEST_PROTOCOL + 1)


def _written(folder: Path, content: bytes, name: str = "file.pkl") -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


def _assert_same(a: Any, b: Any) -> None:
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert list(a) == list(b)
        for key in a:
            _assert_same(a[key], b[key])
    elif isinstance(a, (list, tuple)):
        assert len(a) == len(b)
        for one, other in zip(a, b):
            _assert_same(one, other)
    elif isinstance(a, sparse.csc_matrix | sparse.csr_matrix):
        assert a.shape == b.shape
        np.testing.assert_array_equal(a.toarray(), b.toarray())
    elif isinstance(a, (np.ndarray, np.generic)):
        assert a.dtype == b.dtype
        assert a.shape == b.shape
        if a.dtype == object:
            _assert_same(a.tolist(), b.tolist())
        else:
            np.testing.assert_array_equal(a, b)
    else:
        assert a == b


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_data_comes_back_as_it_was_written(protocol: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    array = rng.normal(size=(4, 3, 2))
    mixed = np.empty(3, object)
    mixed[:] = [{"a": array}, "text", None]
    data = {
        "array": array,
        "fortran": np.asfortranarray(array),
        "big endian": array.astype(">f4"),
        "integers": rng.integers(0, 2**32, (5, 3)).astype(np.uint32),
        "flags": rng.random(7) < 0.5,
        "none of them": np.zeros((0, 3)),
        "names": np.array(["thumb", "index"]),
        "one number": np.float32(2.5),
        "0-d": np.array(3.0),
        "objects": mixed,
        "type": np.dtype("<f8"),
        "csc": sparse.csc_matrix(rng.random((4, 6)) * (rng.random((4, 6)) < 0.3)),
        "csr": sparse.csr_matrix(np.eye(3)),
        "plain": [1, 2.5, True, None, "tekst", "\xe9", b"\x00\xff", b"", (1, (2, 3)), 2**70, 1 + 2j],
        "sets": {1, 2},
        "frozen": frozenset("ab"),
        5: "a number as key",
    }
    data["again"] = data["array"]
    read = load_restricted_pickle(_written(tmp_path, pickle.dumps(data, protocol)))
    _assert_same(read, data)
    assert read["again"] is read["array"]


@pytest.mark.parametrize("renamed", [(b"numpy.core", b"numpy._core"), (b"scipy.sparse._", b"scipy.sparse.")])
@pytest.mark.parametrize("protocol", [0, 2])
def test_module_names_of_other_versions_are_known(
    renamed: tuple[bytes, bytes], protocol: int, tmp_path: Path
) -> None:
    data = {"a": np.arange(3.0), "b": sparse.csc_matrix(np.eye(3)), "c": np.int64(4)}
    content = pickle.dumps(data, protocol)
    assert renamed[0] in content
    _assert_same(load_restricted_pickle(_written(tmp_path, content.replace(*renamed))), data)


def test_npy_of_one_object_is_read_as_numpy_reads_it(tmp_path: Path) -> None:
    motion = {"right_hand": {"trans": np.zeros((5, 3), np.float32)}, "0" * 32: {"angle": np.ones((5, 1))}}
    path = tmp_path / "mano_1.npy"
    np.save(path, np.array(motion, dtype=object), allow_pickle=True)
    _assert_same(load_restricted_npy(path), motion)
    _assert_same(load_restricted_npy(path), np.load(path, allow_pickle=True).item())


class _Runs:
    """Pickles into a call."""

    def __init__(self, call: Callable[..., object], *arguments: object) -> None:
        self.reduced = call, arguments

    def __reduce__(self) -> Any:
        return self.reduced


def _hostile_objects(marker: Path) -> dict[str, object]:
    command, code = f"touch {marker}", f"open({str(marker)!r}, 'w')"
    return {
        "posix.system": _Runs(os.system, command),
        "builtins.eval": _Runs(eval, code),
        "builtins.exec": _Runs(exec, code),
        "builtins.getattr": _Runs(getattr, dict, "get"),
        "io.open": _Runs(open, str(marker), "w"),
        "builtins.__import__": _Runs(builtins.__import__, "antigravity"),
        "numpy.memmap": _Runs(np.memmap, str(marker), "f8", "w+", 0, (3,)),
        "pathlib.PosixPath": Path("a"),
        "functools.partial": _Runs(__import__("functools").partial, os.system, command),
        "numpy.core.multiarray._reconstruct in objects": np.array([_Runs(os.system, command)], dtype=object),
    }


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("name", list(_hostile_objects(Path())))
def test_calls_named_by_a_pickle_are_refused_and_not_made(name: str, protocol: int, tmp_path: Path) -> None:
    marker = tmp_path / "marker"
    content = pickle.dumps({"v_template": _hostile_objects(marker)[name]}, protocol)
    with pytest.raises(InputError, match="it names ") as error:
        load_restricted_pickle(_written(tmp_path, content))
    assert "\n" not in str(error.value)
    assert not marker.exists()
    if "system" in name or "eval" in name:  # the file is really hostile
        pickle.loads(content)
        assert marker.exists()


def test_npy_with_a_call_inside_is_refused(tmp_path: Path) -> None:
    marker = tmp_path / "marker"
    path = tmp_path / "mano_1.npy"
    np.save(path, np.array(_Runs(os.system, f"touch {marker}"), dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match=r"it names posix\.system"):
        load_restricted_npy(path)
    assert not marker.exists()


def _global(name: str) -> bytes:
    module, _, item = name.rpartition(".")
    return f"c{module}\n{item}\n".encode()


def _text(text: str) -> bytes:
    return b"X" + struct.pack("<I", len(text)) + text.encode()


RECONSTRUCT, NDARRAY = _global("numpy.core.multiarray._reconstruct"), _global("numpy.ndarray")
ARRAY = RECONSTRUCT + b"(" + NDARRAY + b"(K\x00tU\x01btR"  # an empty array that awaits its state
F8 = _global("numpy.dtype") + b"(" + _text("f8") + b"I0\nI1\ntR"
CSC = _global("scipy.sparse.csc.csc_matrix")
INSTRUCTIONS = {
    "state of a callable": RECONSTRUCT + b"}" + _text("call") + _global("numpy.dtype") + b"sb.",
    "slots of a callable": RECONSTRUCT + b"N}" + _text("call") + _global("numpy.dtype") + b"s\x86b.",
    "state of a class": CSC + b"}" + _text("__setstate__") + RECONSTRUCT + b"sb.",
    "slots of a class": CSC + b"N}" + _text("__setstate__") + RECONSTRUCT + b"s\x86b.",
    "slots of an object": CSC + b")\x81N}" + _text("__class__") + CSC + b"s\x86b.",
    "state twice": CSC + b")\x81}b}b.",
    "new object with arguments": CSC + b"(I1\nt\x81.",
    "new object of a function": RECONSTRUCT + b")\x81.",
    "array of another type": RECONSTRUCT + b"(" + CSC + b"(K\x00tU\x01btR.",
    "array of a huge shape": RECONSTRUCT + b"(" + NDARRAY + b"(J\xff\xff\xff\x7ftU\x01btR.",
    "huge shape in the state": ARRAY + b"(K\x01(J\xff\xff\xff\x7fJ\xff\xff\xff\x7ft" + F8 + b"I00\nU\x00tb.",
    "negative shape": ARRAY + b"(K\x01(J\xff\xff\xff\xfft" + F8 + b"I00\nU\x00tb.",
    "array without a state": ARRAY + b".",
    "empty items in a huge shape": ARRAY
    + b"(K\x01(J\xff\xff\xff\x7ft"
    + _global("numpy.dtype")
    + b"("
    + _text("S0")
    + b"I0\nI1\ntRI00\nU\x00tb.",
    "structured type": _global("numpy.dtype") + b"(" + _text("f8,O") + b"I0\nI1\ntR.",
    "ndarray called": NDARRAY + b"(J\xff\xff\xff\x7ftR.",
    "a global as data": NDARRAY + b".",
    "persistent id": b"Pos.system\n.",
    "binary persistent id": b"K\x01Q.",
    "unknown extension code": b"\x82\x01.",
    "reconstructor with another class": _global("copyreg._reconstructor")
    + b"("
    + NDARRAY
    + _global("builtins.object")
    + b"NtR.",
    "reconstructor with another base": _global("copyreg._reconstructor") + b"(" + CSC + CSC + b"NtR.",
    "codec that is no text encoding": _global("_codecs.encode") + b"(" + _text("a") + _text("zip") + b"tR.",
    "dotted name": b"\x80\x04" + _text("numpy") + _text("ndarray.tofile") + b"\x93.",
    "name of several lines": b"\x80\x04" + _text("os\n\x1b[2J") + _text("system\n") + b"\x93.",
    "called number": b"K\x01)R.",
    "instance of the old kind": b"(ios\nsystem\n.",
    "list in itself": b"]q\x00h\x00a.",
    "out of band buffer": b"\x80\x05\x97.",
    "deep nesting": b"]" * 5000 + b"a" * 4999 + b".",
    "sparse matrix with indices outside": CSC
    + b")\x81"
    + pickle.dumps(
        {
            "data": np.ones(1),
            "indices": np.array([2**30]),
            "indptr": np.array([0, 1]),
            "_shape": (16, 1),
        },
        2,
    )[2:-1]
    + b"b.",
}


@pytest.mark.parametrize("name", list(INSTRUCTIONS))
def test_odd_instructions_end_as_one_line(name: str, tmp_path: Path) -> None:
    classes = [vars(restricted_pickle)[kind] for kind in ("_Csc", "_WithState", "_Array", "_Named")]
    before = [dict(vars(kind)) for kind in classes]
    with pytest.raises(InputError) as error:
        load_restricted_pickle(_written(tmp_path, INSTRUCTIONS[name]))
    assert str(error.value).isprintable()
    assert len(str(error.value)) < 600
    assert [dict(vars(kind)) for kind in classes] == before


def test_extension_codes_of_the_process_lead_nowhere_else(tmp_path: Path) -> None:
    copyreg.add_extension("os", "system", 200)
    try:
        with pytest.raises(InputError, match=r"it names os\.system"):
            load_restricted_pickle(_written(tmp_path, b"\x82\xc8."))
    finally:
        copyreg.remove_extension("os", "system", 200)


def _zip() -> bytes:
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w") as archive:
        archive.writestr("models/MANO_RIGHT.pkl", b"")
    return held.getvalue()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (b"\n\n<!DOCTYPE html><html><body>Sign in</body></html>", "web page"),
        (b"\xef\xbb\xbf<html>", "web page"),
        (_zip(), "zip archive"),
        (b"\x1f\x8b\x08\x00", "gzip archive"),
        (b"please register first\n", "cannot be read as a pickle"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "Git LFS pointer"),
        (bytes(range(256)), "cannot be read as a pickle"),
        (pickle.dumps({"a": np.arange(1000.0)})[:-700], "cannot be read as a pickle"),
        (b"\x80\x63.", "cannot be read as a pickle"),
    ],
)
def test_files_that_are_no_pickles_say_what_they_are(content: bytes, message: str, tmp_path: Path) -> None:
    path = _written(tmp_path, content)
    for load in (load_restricted_pickle, load_restricted_npy):
        with pytest.raises(InputError) as error:
            load(path)
        assert str(error.value).startswith(f"{path}: ")
        assert "\n" not in str(error.value)
    with pytest.raises(InputError, match=message):
        load_restricted_pickle(path)


def test_missing_file_and_folder_are_named(tmp_path: Path) -> None:
    for path in (tmp_path / "none.pkl", tmp_path):
        for load in (load_restricted_pickle, load_restricted_npy):
            with pytest.raises(InputError, match="cannot be read"):
                load(path)


@pytest.mark.parametrize("array", [np.zeros(3), np.array([{}, {}], dtype=object)])
def test_npy_of_anything_but_one_object_is_refused(array: np.ndarray, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", array, allow_pickle=True)
    with pytest.raises(InputError, match="the file holds an array of"):
        load_restricted_npy(tmp_path / "a.npy")


@settings(max_examples=300)
@given(place=st.integers(0, 10**6), values=st.binary(min_size=1, max_size=6), as_npy=st.booleans())
def test_damaged_files_give_data_or_one_line(
    place: int, values: bytes, as_npy: bool, tmp_path_factory: pytest.TempPathFactory
) -> None:
    data = {"a": np.random.default_rng(0).random((3, 2)), "c": [b"x", "y", (1, 2)]}
    data = data if as_npy else data | {"b": sparse.csc_matrix(np.eye(3))}
    held = io.BytesIO()
    if as_npy:
        np.save(held, np.array(data, dtype=object), allow_pickle=True)
    else:
        pickle.dump(data, held, 2)
    content = bytearray(held.getvalue())
    place %= len(content)
    content[place : place + len(values)] = values
    path = _written(tmp_path_factory.getbasetemp(), bytes(content), "damaged")
    with contextlib.suppress(InputError):
        (load_restricted_npy if as_npy else load_restricted_pickle)(path)
