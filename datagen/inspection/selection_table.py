"""How many motions each rule of the selection removed."""

import re
from collections.abc import Sequence

from datagen.inspection.fitting_table import FittingTable, TableColumn
from datagen.jobs.select_motions import Selection
from datagen.plan.selection_rules import Decision, Rule, removed_by_rule
from shards.printable import printable

__all__ = ["selection_lines", "selection_table"]

_SHOWN = 20  # lines of one sort
_PARTICULARS = re.compile(r"'[^']*'|\"[^\"]*\"|\S*/\S*|\d[\d.,]*")  # names, paths and numbers in a note


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
    """What was removed, in one line; what cannot be used, was joined or guessed; takedown entries in vain."""
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
    lines += _shortened(_unusable(selection), "more that cannot be used")
    lines += _shortened(list(selection.notes), "more of such lines")
    return [printable(line) for line in (*lines, *_reading_notes(selection))]


def _shortened(lines: Sequence[str], what: str) -> list[str]:
    more = [f"{len(lines) - _SHOWN:,} {what}"] if len(lines) > _SHOWN else []
    return [*lines[:_SHOWN], *more]


def _unusable(selection: Selection) -> list[str]:
    """One line an object."""
    reasons = {d.object_uid: d.reason for d in selection.decisions if d.rule == Rule.UNUSABLE.value}
    return [f"cannot be used: {uid}: {reason}" for uid, reason in reasons.items()]


def _reading_notes(selection: Selection) -> list[str]:
    """What readers guessed or left out: one line a kind, with the first object that it was said of."""
    first: dict[str, tuple[str, str]] = {}
    objects: dict[str, set[str]] = {}
    for decision in selection.decisions:
        for note in decision.notes:
            kind = _PARTICULARS.sub("", note)
            first.setdefault(kind, (decision.object_uid, note))
            objects.setdefault(kind, set()).add(decision.object_uid)
    return [
        f"note: {uid}: {note}"
        + (f" (and {len(objects[kind]) - 1:,} like it)" if len(objects[kind]) > 1 else "")
        for kind, (uid, note) in first.items()
    ]
