"""How well a hand replays recorded motions: contact distances of every sequence."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from datagen.grasps.recorded.replay_report import ReplayOutcome
from datagen.grasps.sequence import GraspSequence
from datagen.inspection.fitting_table import FittingTable, TableColumn

__all__ = ["replay_table"]

# In the order of `_cells`, with the rank of each.
_NUMBERS = (
    ("held", 5), ("rise", 4), ("slip", 3), ("depth", 1), ("touch", 2), ("thumb index mid. ring pinky", 0),
)  # fmt: skip


def replay_table(outcomes: Sequence[ReplayOutcome]) -> FittingTable:
    """One row per sequence, then medians; millimetres. Digits: distance to the object, negative inside."""
    replayed = [(outcome, outcome.sequence) for outcome in outcomes if outcome.sequence is not None]
    refused = [f"left out: {outcome.reason}" for outcome in outcomes if outcome.sequence is None]
    notes = [f"{len(replayed)} of {len(outcomes)} replayed"]
    if replayed:
        hand = replayed[0][1]
        if hand.stands_in_for:
            notes.append(f"{hand.hand_model} stands in for {hand.stands_in_for}: contacts are approximate")
        notes.append(f"{np.median([outcome.cpu_seconds for outcome, _ in replayed]):.1f} s of CPU per motion")
    columns = [
        TableColumn(name="sequence"),
        *(TableColumn(name=name, is_number=True, rank=rank) for name, rank in _NUMBERS),
    ]
    table = FittingTable("replayed motions (mm; held in s)", columns, notes=[*notes, *refused])
    metrics = np.array([_metrics(sequence) for _, sequence in replayed]).reshape(-1, 10)
    for (outcome, _), row in zip(replayed, metrics):
        table.add_row(_short(outcome.sequence_id), *_cells(row))
    if replayed:
        table.add_section()
        for name, row in (("median", np.median(metrics, axis=0)), ("largest", metrics.max(axis=0))):
            table.add_row(name, *_cells(row))
    return table


def _short(sequence_id: str) -> str:
    """mano_dataset_1/large/<32 digits>/mano_4 -> 1/large/<8 digits>/4."""
    part, size, object_id, stem = sequence_id.split("/")
    return f"{part.rpartition('_')[2]}/{size}/{object_id[:8]}/{stem.rpartition('_')[2]}"


def _metrics(sequence: GraspSequence) -> Float[np.ndarray, "10"]:
    quality = sequence.quality
    carried_s = (len(sequence.hand_pose) - sequence.grasp_frame) / sequence.fps
    millimetres = 1e3 * np.array(
        [quality.rise_m, quality.slip_lift_m, quality.max_penetration_m, *quality.digit_distance_m]
    )
    return np.array([carried_s, *millimetres[:3], quality.digits_in_contact, *millimetres[3:]])


def _cells(metrics: Float[np.ndarray, "10"]) -> list[str]:
    held, rise, slip, depth, digits, *distances = metrics.tolist()
    by_digit = " ".join(f"{distance:4.1f}" for distance in distances)
    return [f"{held:.2f}", f"{rise:.0f}", f"{slip:.1f}", f"{depth:.1f}", f"{digits:.0f}", by_digit]
