"""What a plan will make, as a table."""

from collections import Counter
from pathlib import Path

from datagen.inspection.fitting_table import FittingTable, TableColumn
from datagen.plan.plan import Plan
from shards.splits import object_identity

__all__ = ["plan_table"]


def plan_table(plan: Plan, out: Path) -> FittingTable:
    """Counts per split and in all; the cost is in pixels times samples, because machines differ."""
    numbers = ("objects", "motions", "clips", "frames", "pixel samples")
    table = FittingTable(
        f"plan of {out}",
        [TableColumn(name="split"), *(TableColumn(name=name, is_number=True) for name in numbers)],
        notes=[f"{plan.n_shards:,} shards of up to {len(plan.shard(0))} motions"],
    )
    splits = Counter(motion.split for motion in plan.motions)
    for split in (*sorted(splits), "all"):
        motions = [motion for motion in plan.motions if split in (motion.split, "all")]
        table.add_row(
            split,
            f"{len({object_identity(motion.object_uid) for motion in motions}):,}",
            f"{len(motions):,}",
            f"{sum(motion.n_cameras for motion in motions):,}",
            f"{sum(motion.n_cameras * motion.n_frames for motion in motions):,}",
            f"{sum(motion.cost_megapixel_samples for motion in motions) / 1e3:,.2f} G",
        )
    return table
