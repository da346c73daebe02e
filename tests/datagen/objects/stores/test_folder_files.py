"""Links are followed once, what a system left behind is skipped, and nothing on a disk is a traceback."""

import os
import socket
from pathlib import Path

import pytest

from datagen.objects.stores.folder_files import find_files, pointed_to


def write(path: Path, text: str = "x") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def places(root: Path) -> list[str]:
    return [file.place for file in find_files(root).files]


def test_hidden_files_and_what_systems_leave_are_skipped(tmp_path):
    for name in (
        "a.glb", "._a.glb", ".git/b.glb", "__MACOSX/._a.glb", "@eaDir/a.glb", "$RECYCLE.BIN/c.glb", "sub/d.glb",
    ):  # fmt: skip
        write(tmp_path / name)
    found = find_files(tmp_path)
    assert [file.place for file in found.files] == ["a.glb", "sub/d.glb"]
    assert found.hidden == ("$RECYCLE.BIN", "._a.glb", ".git", "@eaDir", "__MACOSX")


def test_a_hidden_folder_itself_may_be_given(tmp_path):
    write(tmp_path / ".cache" / "a.glb")
    assert places(tmp_path / ".cache") == ["a.glb"]


def test_links_are_followed_once(tmp_path):
    root, elsewhere = tmp_path / "root", tmp_path / "elsewhere"
    write(elsewhere / "cup.glb")
    write(tmp_path / "store" / "blob")
    write(root / "z" / "plain.glb")
    (root / "linked").symlink_to("../elsewhere")
    (root / "linked_again").symlink_to(elsewhere)
    (root / "hub.glb").symlink_to("../store/blob")  # the name tells the format, as in a hub's cache
    (root / "a_link").symlink_to("z")  # sorts before what it leads to
    (root / "z" / "up").symlink_to("..")
    (elsewhere / "round").symlink_to(root)
    assert places(root) == ["hub.glb", "linked/cup.glb", "z/plain.glb"]


def test_a_file_keeps_the_name_it_has_without_links(tmp_path):
    write(tmp_path / "z.glb")
    (tmp_path / "a.glb").symlink_to("z.glb")
    assert places(tmp_path) == ["z.glb"]


def test_what_is_no_readable_file_has_a_fault(tmp_path):
    (tmp_path / "gone.glb").symlink_to("../annex/object")
    (tmp_path / "loop.glb").symlink_to("loop.glb")
    os.mkfifo(tmp_path / "pipe.glb")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "s.glb"))
        faults = {file.place: file.fault for file in find_files(tmp_path).files}
    assert "a link to '../annex/object', which is not there" in faults["gone.glb"]
    assert "which is not there" in faults["loop.glb"]
    assert "a pipe" in faults["pipe.glb"]
    assert "a pipe, a socket" in faults["s.glb"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_what_may_not_be_read_is_told(tmp_path):
    write(tmp_path / "a.glb").chmod(0)
    write(tmp_path / "closed" / "b.glb")
    (tmp_path / "closed").chmod(0)
    try:
        found = find_files(tmp_path)
    finally:
        (tmp_path / "closed").chmod(0o755)
    assert [(file.place, "permissions" in file.fault) for file in found.files] == [("a.glb", True)]
    assert found.unreadable == ("closed (Permission denied)",)


def test_any_name_is_found(tmp_path):
    names = [b"two\nlines.glb", b"not\xffutf.glb", b"x" * 250 + b".glb", "é@[b].glb".encode()]
    for name in names:
        (Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name))).write_bytes(b"x")
    assert {os.fsencode(place) for place in places(tmp_path)} == set(names)


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 9\n", "a Git LFS pointer"),
        (b"/annex/objects/SHA256E-s9--00.glb\n", "a pointer of git-annex"),
        (b"../../.git/annex/objects/a/b/SHA", "a pointer of git-annex"),
        (b"../store/blob0", "a link to '../store/blob0' that was unpacked as text"),
        (b"other.obj\n", "a link to 'other.obj' that was unpacked as text"),
        (b"", ""),
        (b"v 0 0 0\n", ""),
        (b"solid\nendsolid", ""),
        (b"\xff\xfe/", ""),
        (b"a/b " * 400, ""),
    ],
)
def test_pointers_are_told_from_content(tmp_path, content, what):
    path = tmp_path / "mug.obj"
    path.write_bytes(content)
    assert pointed_to(path) == what
