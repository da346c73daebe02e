"""No cell is ever cut: columns give way instead, in the order of their rank, and the table says which."""

import io

import pytest
from rich.console import Console

from datagen.inspection.fitting_table import FittingTable, TableColumn

UID = "objaverse/0123456789abcdef0123456789abcdef@large-mirrored"


def printed(table: FittingTable, width: int) -> list[str]:
    console = Console(width=width, file=io.StringIO(), record=True)
    console.print(table)
    lines = console.export_text().splitlines()
    assert all(len(line) <= width for line in lines)
    return [line.rstrip() for line in lines]


def table() -> FittingTable:
    columns = [
        TableColumn(name="object"),
        TableColumn(name="licence", folds=True),
        TableColumn(name="author", rank=2),
        TableColumn(name="clips", is_number=True, rank=1),
    ]
    made = FittingTable("objects", columns, notes=["a note"])
    made.add_row("starter/mug", "CC0-1.0", "somebody [of Rome]", "4")
    made.add_section()
    made.add_row(UID, "CC-BY-NC-4.0 AND CC-BY-4.0", "x", "12")
    return made


def test_all_columns_where_there_is_room():
    lines = printed(table(), 160)
    assert lines[0] == "objects"
    assert lines[1].split() == ["object", "licence", "author", "clips"]
    assert lines[3].split("  ")[0] == "starter/mug"
    assert "somebody [of Rome]" in lines[3]  # no markup
    assert set(lines[4]) <= {"─", " "}
    assert lines[5].split() == [UID, "CC-BY-NC-4.0", "AND", "CC-BY-4.0", "x", "12"]
    assert lines[6] == "a note"


@pytest.mark.parametrize(
    ("width", "left_out"), [(90, "author"), (80, "author"), (72, "author, clips"), (71, "author, clips")]
)
def test_columns_go_by_rank_and_are_named(width, left_out):
    lines = printed(table(), width)
    assert f"wider terminals also show: {left_out}" in lines
    assert any(line.startswith(f"{UID}  CC-BY-NC-4.0") for line in lines)
    assert ("clips" in lines[1]) == ("clips" not in left_out)


def test_a_name_wider_than_the_terminal_is_folded_not_cut():
    lines = printed(table(), 40)
    assert UID in "".join(line.split("  ")[0].strip() for line in lines)
    assert all(any(word in line for line in lines) for word in ("starter/mug", "CC0-1.0", "CC-BY-4.0"))


def test_rows_have_a_cell_for_every_column():
    with pytest.raises(ValueError, match="objects: expected 4 cells, found 1"):
        table().add_row("x")
