"""Objects that a dataset beside this one holds under another name: trained on together they could straddle splits."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from datagen.plan.plan import SELECTION_FILE
from datagen.plan.same_objects import same_shapes
from datagen.plan.selection_rules import Decision
from shards.splits import SplitRule, object_identity, split_of_object

__all__ = ["said_of_neighbours"]

_COLUMNS = ["object_uid", "kept", "shape"]


def said_of_neighbours(out: Path, decisions: tuple[Decision, ...], split_rule: SplitRule) -> tuple[str, ...]:
    """A line on each dataset in the folder of `out` that holds objects of the same surface under other identities.

    `split_rule` is that of `out`. Selections that cannot be read, or were made before fingerprints, say nothing.
    """
    ours = {decision.object_uid: decision.shape for decision in decisions if decision.kept and decision.shape}
    lines = []
    for path in sorted(out.resolve().parent.glob(f"*/{SELECTION_FILE}")):
        if ours and path.parent != out.resolve():
            line = _said(path, ours, split_rule)
            lines += [line] if line else []
    return tuple(lines)


def _said(path: Path, ours: dict[str, tuple[float, ...]], split_rule: SplitRule) -> str:
    theirs = _shapes(path)
    if not theirs:
        return ""
    our_uids, their_uids = list(ours), list(theirs)
    found: dict[str, set[str]] = {}
    for one, other in same_shapes(np.array(list(ours.values())), np.array(list(theirs.values()))):
        found.setdefault(object_identity(our_uids[one]), set()).add(object_identity(their_uids[other]))
    renamed = {uid: min(names) for uid, names in found.items() if uid not in names}
    if not renamed:
        return ""
    apart = [
        (uid, name)
        for uid, name in renamed.items()
        if split_of_object(uid, split_rule) != split_of_object(name, split_rule)
    ]
    our, their = (apart or list(renamed.items()))[0]
    return (
        f"{path.parent.name} beside it has {len(renamed):,} of these shapes under another name "
        f"({len(apart):,} of them in another split), such as {their} for {our}: "
        "do not train on one dataset and test on the other"
    )


def _shapes(path: Path) -> dict[str, tuple[float, ...]]:
    try:
        rows = pq.read_table(path, columns=_COLUMNS).to_pylist()
    except (pa.ArrowException, OSError, ValueError):
        return {}
    return {row["object_uid"]: tuple(row["shape"]) for row in rows if row["kept"] and row["shape"]}
