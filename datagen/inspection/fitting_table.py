"""Tables whose cells stay whole: where the terminal is too narrow, columns give way, least important first."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions
from rich.table import Table
from rich.text import Text

__all__ = ["FittingTable", "TableColumn"]

_GAP = 2  # blanks between columns


@dataclass(frozen=True, kw_only=True)
class TableColumn:
    """A column of text, or of numbers."""

    name: str
    is_number: bool = False
    rank: int = 0  # 0: always there; of the others the highest goes first
    folds: bool = False  # may run over several lines before it is cut; names and ids never do


class FittingTable:
    """A rich renderable. Cells are plain text: brackets in a name are no markup."""

    def __init__(self, title: str, columns: Sequence[TableColumn], *, notes: Sequence[str] = ()) -> None:
        """`notes` are lines below the table."""
        self._title = title
        self._columns = tuple(columns)
        self._notes = list(notes)
        self._rows: list[tuple[str, ...]] = []
        self._sections: set[int] = set()  # rows that begin one

    def add_row(self, *cells: str) -> None:
        """One cell for every column."""
        if len(cells) != len(self._columns):
            raise ValueError(f"{self._title}: expected {len(self._columns)} cells, found {len(cells)}")
        self._rows.append(cells)

    def add_section(self) -> None:
        """A line between the rows before and those that come."""
        self._sections.add(len(self._rows))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table | Text]:
        kept = self._fitting(options.max_width)
        fits = self._least_total(kept) <= options.max_width  # else names fold too: nothing is cut off
        table = Table(
            box=box.SIMPLE_HEAD,
            padding=(0, 1, 0, 0),
            show_edge=False,
            pad_edge=False,
            show_header=any(column.name for column in self._columns),
        )
        for index in kept:
            column = self._columns[index]
            justify: Literal["left", "right"] = "right" if column.is_number else "left"
            table.add_column(column.name, justify=justify, no_wrap=fits and not column.folds, overflow="fold")
        for number, row in enumerate(self._rows):
            if number in self._sections:
                table.add_section()
            table.add_row(*(Text(row[index]) for index in kept))
        yield Text(self._title, style="table.title")
        yield table
        dropped = [column.name for index, column in enumerate(self._columns) if index not in kept]
        notes = [*self._notes, *([f"wider terminals also show: {', '.join(dropped)}"] if dropped else [])]
        yield from (Text(note, style="table.caption") for note in notes)
        yield Text()

    def _fitting(self, width: int) -> list[int]:
        """Indices of the columns that are shown."""
        kept = list(range(len(self._columns)))
        while self._least_total(kept) > width:
            last = max(kept, key=lambda index: self._columns[index].rank)
            if self._columns[last].rank == 0:
                break  # nothing left to leave out
            kept.remove(last)
        return kept

    def _least_total(self, kept: Sequence[int]) -> int:
        return sum(self._least_width(index) for index in kept) + _GAP * (len(kept) - 1)

    def _least_width(self, index: int) -> int:
        column = self._columns[index]
        cells = [column.name, *(row[index] for row in self._rows)]
        if column.folds:
            cells = [word for cell in cells for word in cell.split()]
        return max((cell_len(cell) for cell in cells), default=0)
