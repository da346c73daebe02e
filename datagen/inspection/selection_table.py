"""How many motions each rule of the selection removed."""

from collections.abc import Sequence

from rich.table import Table

from datagen.selection import Decision, removed_by_rule

__all__ = ["selection_line", "selection_table"]


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


def selection_line(decisions: Sequence[Decision]) -> str:
    """What was removed, in one line."""
    removed = [
        f"{motions:,} {rule.value}" for rule, (motions, _) in removed_by_rule(decisions).items() if motions
    ]
    kept = sum(decision.kept for decision in decisions)
    reasons = f"; removed: {', '.join(removed)}" if removed else ""
    return f"selection: {kept:,} of {len(decisions):,} motions kept{reasons}"
