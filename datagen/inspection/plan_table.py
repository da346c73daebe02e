"""What a plan will make, as a table."""

from collections import Counter
from pathlib import Path

from rich.table import Table

from datagen.plan.plan import Plan
from shards.splits import object_identity

__all__ = ["plan_table"]


def plan_table(plan: Plan, out: Path) -> Table:
    """Counts per split and in all; the cost is in pixels times samples, because machines differ."""
    table = Table(title=f"plan of {out}", title_justify="left")
    for column in ("split", "objects", "motions", "clips", "frames", "pixel samples"):
        table.add_column(column, justify="left" if column == "split" else "right")
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
    table.caption = f"{plan.n_shards:,} shards of up to {max(len(plan.shard(0)), 1)} motions"
    return table
