"""The inputs of the generator as one table."""

from collections.abc import Sequence

from rich.table import Table

from datagen.inspection.inventory import AssetState

__all__ = ["asset_table"]

MARKS = {"present": "[green]present[/]", "missing": "[yellow]missing[/]", "wrong": "[red]wrong[/]"}


def asset_table(states: Sequence[AssetState]) -> Table:
    """One row per input; readable at 80 columns."""
    table = Table(title="inputs", title_justify="left", show_lines=True)
    for column, share in (("input, licence", 2), ("state, version", 2), ("place, setting, how to get it", 4)):
        table.add_column(column, overflow="fold", ratio=share)
    for state in states:
        found = [MARKS[state.state], state.version, state.problem]
        table.add_row(
            f"{state.name}\n[dim]{state.licence}[/]",
            "\n".join(line for line in found if line),
            f"{state.place}\n[dim]{state.setting}[/]\n{state.how_to_get}",
        )
    return table
