"""How many motions each rule of the selection removed."""

from collections.abc import Sequence

from rich.table import Table

from datagen.jobs.select_motions import Selection
from datagen.plan.selection_rules import Decision, removed_by_rule

__all__ = ["selection_lines", "selection_table"]


def selection_table(decisions: Sequence[Decision]) -> Table:
    """One row per rule, in the order in which they apply, and what is kept."""
    table = Table(title="selection", title_justify="left")
    for column in ("rule", "motions", "objects", "example"):
        table.add_column(column, justify="right" if column in ("motions", "objects") else "left")
    for rule, (motions, objects) in removed_by_rule(decisions).items():
        first = next((decision for decision in decisions if decision.rule == rule.value), None)
        example = "" if first is None else f"{first.sequence_id or first.object_uid}: {first.reason}"
        table.add_row(rule.value, f"{motions:,}", f"{objects:,}", example)
    table.add_section()
    kept = [decision for decision in decisions if decision.kept]
    table.add_row("kept", f"{len(kept):,}", f"{len({d.object_uid for d in kept}):,}", "")
    table.add_row("all", f"{len(decisions):,}", f"{len({d.object_uid for d in decisions}):,}", "")
    return table


def selection_lines(selection: Selection) -> list[str]:
    """What was removed, in one line, and what the takedown list names in vain."""
    removed = [
        f"{motions:,} {rule.value}"
        for rule, (motions, _) in removed_by_rule(selection.decisions).items()
        if motions
    ]
    reasons = f"; removed: {', '.join(removed)}" if removed else ""
    lines = [f"selection: {len(selection.kept):,} of {len(selection.decisions):,} motions kept{reasons}"]
    if selection.unmatched:
        lines.append(
            f"entries of your takedown list that name nothing here: {', '.join(selection.unmatched)}"
        )
    return lines
