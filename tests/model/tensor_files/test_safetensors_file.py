"""Files that are given as safetensors and are none: what they are is said in one line, with what to do."""

import gzip
import io
import json
import os
import zipfile
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from model.errors import ModelError
from model.tensor_files.file_content import content_of
from model.tensor_files.safetensors_file import KeyComparison, read_header


def fails(path: Path, *parts: str) -> None:
    with pytest.raises(ModelError) as caught:
        read_header(path, expected="weights", action="Do something.")
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith(f"{path}: ")
    assert "expected weights" in text
    assert all(part in text for part in parts), text


@pytest.fixture
def whole(tmp_path: Path) -> bytes:
    """64 x 64 float16 behind their header."""
    save_file({"a": torch.ones(64, 64, dtype=torch.float16)}, tmp_path / "whole.safetensors")
    return (tmp_path / "whole.safetensors").read_bytes()


def zipped() -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("weights.safetensors", b"x")
    return buffer.getvalue()


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a214614ab2935c943f9e0ff69d22eadbb8f32\nsize 5\n"
DOCTYPE = "\N{ZERO WIDTH NO-BREAK SPACE}\n<!DOCTYPE html><html>Log in</html>".encode()
MISTAKEN = [
    (POINTER, "Git LFS pointer", "git lfs pull"),
    (b"/annex/objects/SHA256E-s1130--4d7a.safetensors\n", "git-annex pointer", "git annex get"),
    (DOCTYPE, "web page", "Log in"),
    (b"<html>" + b" " * 4000, "web page", "Log in"),
    (b'{"error": "Repository not found"}', "JSON text", "Download"),
    (b"Invalid username or password.", "the text 'Invalid username or password.'", "Download"),
    (b"../../../blobs/4d7a214614", "text of a link to ../../../blobs/4d7a214614", "with its links"),
    (b"", "it is empty", "Download"),
    (bytes(4096), "bytes are zero", "Download"),
    (b"GGUF" + bytes(100), "GGUF", "original"),
    (gzip.compress(b"x" * 1000), "gzip archive", "Unpack"),
    (zipped(), "zip archive", "Unpack"),
    (zipped()[:40], "cut off after 40 bytes", "Download"),
]


@pytest.mark.parametrize(("content", "what", "action"), MISTAKEN, ids=[what for _, what, _ in MISTAKEN])
def test_what_is_no_safetensors_file_is_named(tmp_path: Path, content: bytes, what: str, action: str) -> None:
    path = tmp_path / "weights.safetensors"
    path.write_bytes(content)
    fails(path, "is no complete safetensors file", what, action)


def test_a_file_that_was_cut_off_says_how_much_is_there(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "weights.safetensors"
    header = 8 + int.from_bytes(whole[:8], "little")
    assert len(whole) == header + 2 * 64 * 64
    for n_bytes, end in (
        (len(whole) - 1, len(whole)),
        (header + 100, len(whole)),
        (header - 1, header),
        (12, header),
    ):
        path.write_bytes(whole[:n_bytes])
        fails(path, f"it has {n_bytes} of {end} bytes: an interrupted download", "Download the file again")
    path.write_bytes(whole + b"xy")
    fails(path, "2 bytes follow its last tensor")


def test_what_is_no_file_is_not_opened(tmp_path: Path) -> None:
    folder, pipe, link = tmp_path / "folder", tmp_path / "pipe", tmp_path / "link"
    folder.mkdir()
    os.mkfifo(pipe)
    link.symlink_to("../blobs/0000")
    fails(folder, "is a folder, not a file")
    fails(pipe, "is a named pipe, not a file")
    fails(link, "is a link to ../blobs/0000, where there is no file")
    fails(tmp_path / "none", "there is no such file", "Do something.")
    fails(tmp_path / ("long" * 100), "cannot be read (File name too long)")
    link.unlink()
    link.symlink_to(link)
    fails(link, "cannot be read", "symbolic links")


def test_a_name_that_is_no_utf_8_is_asked_to_be_another(tmp_path: Path, whole: bytes) -> None:
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/w\xff.safetensors"))
    path.write_bytes(whole)
    fails(path, "its path holds bytes that are no UTF-8", "Rename the file or folder")


def test_the_content_decides_not_the_name(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "weights"
    for content, kind in (
        (whole, "safetensors"),
        (whole[:20], "safetensors"),
        (b"", "other"),
        (zipped(), "other"),
    ):
        path.write_bytes(content)
        assert content_of(path) == kind
    for is_zip in (True, False):
        torch.save({"a": torch.ones(2)}, path, _use_new_zipfile_serialization=is_zip)
        assert content_of(path) == "torch"


def test_damaged_headers_never_end_otherwise(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "weights.safetensors"
    for header in (
        {"a": 1},
        {"a": {"dtype": "F16", "shape": [2], "data_offsets": [0]}},
        [1],
        "x",
        {"a": {"dtype": "X"}},
    ):
        text = json.dumps(header).encode()
        path.write_bytes(len(text).to_bytes(8, "little") + text)
        fails(path, "is no complete safetensors file")
    for position in range(64):
        path.write_bytes(whole[:position] + b"\xff" + whole[position + 1 :])
        fails(path, "is no complete safetensors file")


def test_other_number_formats_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    for dtype, name in ((torch.float64, "F64"), (torch.int8, "I8")):
        save_file({"a": torch.ones(2), "b": torch.ones(2).to(dtype)}, path)
        with pytest.raises(ModelError, match=rf"stores b as {name} \(1 such tensors\).*F32, F16, BF16"):
            read_header(path, expected="weights", action="")


def test_keys_that_do_not_fit_are_counted_and_the_first_named() -> None:
    keys = KeyComparison(
        used=("a",),
        missing=("b", "c", "d", "e"),
        unused=(),
        mismatched=("f (1,) in the file, (2,) in the module",),
    )
    assert keys.problem() == (
        "4 missing (b; c; d ...), 0 unused, 1 of another shape (f (1,) in the file, (2,) in the module)"
    )
