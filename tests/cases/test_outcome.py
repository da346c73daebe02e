"""The program that runs the case folders: what it calls right, refused, wrong and a traceback."""

import time
from pathlib import Path

import pytest

from model.errors import ModelError
from shards.errors import ShardError
from tests.cases.__main__ import CASES, main
from tests.cases.outcome import Case, outcome_of


def case(check, *, folder: str = "x01_box", refused_is_right: bool = False) -> Case:
    return Case(folder=folder, what="a box", check=check, refused_is_right=refused_is_right)


def raises(error: BaseException):
    def check(folder: Path) -> str:
        raise error

    return check


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "x01_box").mkdir()
    return tmp_path


REFUSAL = ModelError("box.obj", "has no faces", expected="a mesh", action="Export it again.")


@pytest.mark.parametrize(
    ("check", "refused_is_right", "status", "line"),
    [
        (lambda folder: f"red, in {folder.name}", False, "right", "a box: red, in x01_box"),
        (raises(AssertionError("it is white")), False, "wrong", "a box: it is white"),
        (raises(AssertionError("it is white")), True, "wrong", "a box: it is white"),
        (raises(REFUSAL), True, "refused", str(REFUSAL)),
        (raises(REFUSAL), False, "wrong", str(REFUSAL)),
        (raises(ShardError("too short")), True, "refused", "too short"),
        (raises(ShardError("too\nshort")), True, "wrong", "refused in several lines: too short"),
        (raises(ValueError("31 is\nno type")), True, "traceback", "ValueError: 31 is no type"),
        (raises(KeyError("uid")), True, "traceback", "KeyError: 'uid'"),
    ],
)
def test_what_a_check_does_decides(root, check, refused_is_right, status, line) -> None:
    outcome = outcome_of(case(check, refused_is_right=refused_is_right), root)
    assert (outcome.case, outcome.status, outcome.line) == ("x01_box", status, line)
    assert outcome.is_good == (status in ("right", "refused"))


def test_a_check_that_does_not_end_is_stopped_also_where_it_catches_everything(root) -> None:
    def endless(folder: Path) -> str:
        while True:
            try:
                time.sleep(10)
            except Exception:
                continue

    outcome = outcome_of(case(endless), root, limit_s=0.2)
    assert (outcome.status, outcome.line) == ("wrong", "not finished after 0.2 s")
    assert 0.2 <= outcome.seconds < 5


def test_a_line_each_then_the_counts(root, capsys) -> None:
    good = [case(lambda folder: "red"), case(raises(REFUSAL), refused_is_right=True)]
    assert main([str(root)], good) == 0
    first, second, counts = capsys.readouterr().out.splitlines()
    assert first.split() == ["right", "x01_box", "a", "box:", "red", "(0.0", "s)"]
    assert second.startswith("refused    x01_box  box.obj: has no faces")
    assert counts == "1 right, 1 refused, 0 wrong, 0 traceback"
    for bad in (raises(AssertionError()), raises(OSError())):
        assert main([str(root)], [*good, case(bad)]) == 1


def test_folders_without_a_row_and_rows_without_a_folder_are_wrong(root, capsys) -> None:
    (root / "x02_new").mkdir()
    (root / "README.md").touch()
    assert main([str(root)], [case(lambda folder: "red")]) == 1
    assert "wrong      x02_new  no row" in capsys.readouterr().out
    (root / "x02_new").rmdir()
    assert main([str(root)], [case(lambda folder: "red"), case(lambda folder: "red", folder="x03_gone")]) == 1
    assert "wrong      x03_gone  there is no such folder" in capsys.readouterr().out
    assert main([str(root / "nowhere")], []) == 2


def test_rows_say_what_they_are_about() -> None:
    assert CASES
    assert all(row.what and row.folder for row in CASES)
