"""How well a hand replays recorded motions: contact distances of every sequence."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from rich import box
from rich.table import Table

from datagen.grasps.recorded.replay_report import ReplayOutcome
from datagen.grasps.sequence import GraspSequence

__all__ = ["replay_table"]

COLUMNS = ("sequence", "held", "rise", "slip", "depth", "touch", "thumb index mid. ring pinky")


def replay_table(outcomes: Sequence[ReplayOutcome]) -> Table:
    """One row per sequence, then medians; millimetres. Digits: distance to the object, negative inside."""
    table = Table(
        title="replayed motions (mm; held in s)",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        show_edge=False,
        pad_edge=False,
    )
    for column in COLUMNS:
        table.add_column(column, justify="left" if column == "sequence" else "right", no_wrap=True)
    replayed = [(outcome, outcome.sequence) for outcome in outcomes if outcome.sequence is not None]
    metrics = np.array([_metrics(sequence) for _, sequence in replayed]).reshape(-1, 10)
    for (outcome, _), row in zip(replayed, metrics):
        table.add_row(_short(outcome.sequence_id), *_cells(row))
    lines = [f"{len(replayed)} of {len(outcomes)} replayed"]
    if replayed:
        table.add_section()
        for name, row in (("median", np.median(metrics, axis=0)), ("largest", metrics.max(axis=0))):
            table.add_row(name, *_cells(row))
        hand = replayed[0][1]
        if hand.stands_in_for:
            lines.append(f"{hand.hand_model} stands in for {hand.stands_in_for}: contacts are approximate")
        lines.append(f"{np.median([outcome.cpu_seconds for outcome, _ in replayed]):.1f} s of CPU per motion")
    refused = [f"left out: {outcome.reason}" for outcome in outcomes if outcome.sequence is None]
    table.caption = "\n".join([*lines, *refused])
    table.caption_justify = "left"
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
