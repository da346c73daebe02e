"""How well the objects of a library can be grasped, as a table."""

from datagen.grasps.synthesis.report import GraspReport, GraspReportRow
from datagen.inspection.fitting_table import FittingTable, TableColumn

__all__ = ["grasp_table"]

# In the order of `_cells`; what matters least first to go.
_NUMBERS = (
    ("kept", 0),
    ("tries", 4),
    ("depth mm", 1),
    ("digits", 3),
    ("slip mm", 2),
    ("turned", 5),
    ("s", 6),
)


def grasp_table(report: GraspReport) -> FittingTable:
    """One row per object and one of all; metrics are medians over kept motions, seconds of CPU per kept motion."""
    failed = ", ".join(f"{reason} {count}" for reason, count in report.total.failures.items())
    notes = [
        f"{report.objects_kept_share:.0%} of objects with a kept grasp; slip: in the lift / while turned",
        f"failed attempts: {failed or 'none'}",
    ]
    columns = [TableColumn(name="object")]
    columns += [TableColumn(name=name, rank=rank, is_number=True) for name, rank in _NUMBERS]
    table = FittingTable("grasps", columns, notes=notes)
    for row in report.rows:
        table.add_row(*_cells(row))
    table.add_section()
    table.add_row(*_cells(report.total))
    return table


def _cells(row: GraspReportRow) -> tuple[str, ...]:
    return (
        row.object_uid,
        f"{row.kept}/{row.motions}",
        str(row.attempts),
        f"{row.penetration_mm:.1f}",
        f"{row.digits:.0f}",
        f"{row.slip_lift_mm:.1f}/{row.slip_manipulation_mm:.1f}",
        f"{row.rotation_range_deg:.0f}°",
        f"{row.cpu_seconds_per_kept:.1f}",
    )
