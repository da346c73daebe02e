"""How well the objects of a library can be grasped, as a table."""

from rich.table import Table

from datagen.grasps.synthesis.report import GraspReport, GraspReportRow

__all__ = ["grasp_table"]


COLUMNS = ("object", "kept", "tries", "depth mm", "digits", "slip mm", "turned", "s")


def grasp_table(report: GraspReport) -> Table:
    """One row per object and one of all; metrics are medians over kept motions, seconds of CPU per kept motion."""
    table = Table(title="grasps", title_justify="left")
    for column in COLUMNS:
        table.add_column(column, justify="left" if column == "object" else "right")
    for row in report.rows:
        table.add_row(*_cells(row))
    table.add_section()
    table.add_row(*_cells(report.total))
    failed = ", ".join(f"{reason} {count}" for reason, count in report.total.failures.items())
    kept = f"{report.objects_kept_share:.0%} of objects with a kept grasp"
    table.caption = f"{kept}; slip in lift/turn. Failed attempts: {failed or 'none'}"
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
