"""How many motions each rule of the selection removed."""

from collections.abc import Sequence

from datagen.inspection.fitting_table import FittingTable, TableColumn
from datagen.jobs.select_motions import Selection
from datagen.plan.selection_rules import Decision, removed_by_rule

__all__ = ["selection_lines", "selection_table"]


def selection_table(decisions: Sequence[Decision]) -> FittingTable:
    """One row per rule, in the order in which they apply, and what is kept; below it the first case of each rule."""
    removed = removed_by_rule(decisions)
    firsts = {rule: next((d for d in decisions if d.rule == rule.value), None) for rule in removed}
    examples = [
        f"{rule.value}: {first.sequence_id or first.object_uid}: {first.reason}"
        for rule, first in firsts.items()
        if first is not None
    ]
    columns = [TableColumn(name="rule")]
    columns += [TableColumn(name=name, is_number=True) for name in ("motions", "objects")]
    table = FittingTable("selection", columns, notes=examples)
    for rule, (motions, objects) in removed.items():
        table.add_row(rule.value, f"{motions:,}", f"{objects:,}")
    table.add_section()
    kept = [decision for decision in decisions if decision.kept]
    for name, group in (("kept", kept), ("all", decisions)):
        table.add_row(name, f"{len(group):,}", f"{len({decision.object_uid for decision in group}):,}")
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
