"""Files are there whole or not at all, whoever dies in between or writes at the same time."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from shards.storage.whole_file import write_whole


@pytest.mark.parametrize("durable", [False, True])
def test_the_file_is_replaced_at_the_end(tmp_path: Path, durable: bool) -> None:
    path = tmp_path / "record.json"
    path.write_text("old")
    with write_whole(path, durable=durable) as partial:
        partial.write_text("new")
        assert path.read_text() == "old"
        assert partial.parent == path.parent
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "plan.parquet"
    path.write_text("old")

    def interrupted() -> None:
        with write_whole(path) as partial:
            partial.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_block_that_writes_nothing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), write_whole(tmp_path / "nothing"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_others_may_read_what_the_umask_lets_them(tmp_path: Path) -> None:
    """Shards are rendered by one user and read by others; temporary files of tempfile are private."""
    path = tmp_path / "plan.parquet"
    before = os.umask(0o022)
    try:
        with write_whole(path) as partial:
            partial.write_text("plan")
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == 0o644


def test_writers_at_the_same_time_do_not_mix(tmp_path: Path) -> None:
    path = tmp_path / "cache.npz"
    with write_whole(path) as first, write_whole(path) as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert path.read_text() == "first"  # its block ended last
    assert list(tmp_path.iterdir()) == [path]


def test_killed_while_writing_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "dataset.json"
    path.write_text("old")
    code = (
        "import os, signal\n"
        "from pathlib import Path\n"
        "from shards.storage.whole_file import write_whole\n"
        f"with write_whole(Path({str(path)!r})) as partial:\n"
        "    partial.write_text('half')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == -9
    assert path.read_text() == "old"
    with write_whole(path) as partial:
        partial.write_text("new")
    assert path.read_text() == "new"
