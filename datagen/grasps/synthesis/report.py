"""Success table of many syntheses: one typed row per object and a total."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from datagen.grasps.sequence import GraspSequence
from datagen.grasps.synthesis.synthesise import GraspAttemptReport

__all__ = ["GraspReport", "GraspReportRow", "summarise"]


@dataclass(frozen=True, kw_only=True)
class GraspReportRow:
    """Metrics of one object, or of all. Medians over kept motions, NaN when there are none."""

    object_uid: str
    motions: int  # syntheses asked for
    kept: int
    attempts: int  # simulated in all, failed ones included
    success_rate: float  # kept motions per attempt
    penetration_mm: float  # worst instant of a motion, median over motions
    digits: float
    slip_lift_mm: float
    slip_manipulation_mm: float
    rotation_range_deg: float
    cpu_seconds_per_kept: float
    failures: dict[str, int]  # failed attempts per reason


@dataclass(frozen=True, kw_only=True)
class GraspReport:
    """Rows in the order the objects came, and the row of all."""

    rows: tuple[GraspReportRow, ...]
    total: GraspReportRow
    objects_kept_share: float  # objects with at least one kept motion


def summarise(reports: Iterable[GraspAttemptReport]) -> GraspReport:
    """Group by object. ValueError without any report."""
    every = list(reports)
    if not every:
        raise ValueError("no synthesis to report on: run at least one object")
    by_object: dict[str, list[GraspAttemptReport]] = {}
    for report in every:
        by_object.setdefault(report.object_uid, []).append(report)
    rows = tuple(_row(uid, group) for uid, group in by_object.items())
    return GraspReport(
        rows=rows,
        total=_row("all", every),
        objects_kept_share=sum(row.kept > 0 for row in rows) / len(rows),
    )


def _row(uid: str, group: list[GraspAttemptReport]) -> GraspReportRow:
    kept: list[GraspSequence] = [r.sequence for r in group if r.sequence is not None]
    attempts = sum(report.attempts for report in group)
    failures: Counter[str] = Counter()
    for report in group:
        failures.update(report.failure_counts())
    seconds = sum(report.cpu_seconds for report in group)
    return GraspReportRow(
        object_uid=uid,
        motions=len(group),
        kept=len(kept),
        attempts=attempts,
        success_rate=len(kept) / max(attempts, 1),
        penetration_mm=1e3 * _median([s.quality.max_penetration_m for s in kept]),
        digits=_median([float(s.quality.digits_in_contact) for s in kept]),
        slip_lift_mm=1e3 * _median([s.quality.slip_lift_m for s in kept]),
        slip_manipulation_mm=1e3 * _median([s.quality.slip_manipulation_m for s in kept]),
        rotation_range_deg=float(
            np.rad2deg(_median([r.movement.rotation_range_rad for r in group if r.movement is not None]))
        ),
        cpu_seconds_per_kept=seconds / len(kept) if kept else float("nan"),
        failures=dict(failures.most_common()),
    )


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else float("nan")
