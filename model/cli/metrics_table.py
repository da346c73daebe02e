"""The table that ends a training: each metric next to its baseline."""

import math

from rich.table import Table

__all__ = ["metrics_table"]

_DETECTED, _TRUE = "visible mask, as the hand encoder detects it", "visible mask, the true one"
# Metric -> the same metric of its baselines, and what these are.
BASELINES = {
    "voxel_iou": {"mean_shape_iou": "mean training shape"},
    "mask_iou": {"found_visible_iou": _DETECTED, "visible_iou": _TRUE},
    "occluded_mask_iou": {"occluded_found_visible_iou": _DETECTED, "occluded_visible_iou": _TRUE},
}

MEAN_LATENT = "mean_latent_"  # of any metric of stage 2


def metrics_table(title: str, metrics: dict[str, dict[str, float]], caption: str) -> Table:
    """A row for each metric of each component, and another for each further baseline."""
    table = Table(title=title, title_justify="left", caption=caption, caption_justify="left")
    for column in ("component", "metric", "ours", "baseline", "which baseline"):
        table.add_column(column, justify="right" if column in ("ours", "baseline") else "left")
    baselines = {name for known in BASELINES.values() for name in known}
    for component, values in metrics.items():
        for name, value in values.items():
            if name in baselines or name.startswith(MEAN_LATENT):
                continue
            labels = BASELINES.get(name, {f"{MEAN_LATENT}{name}": "mean latent"})
            known = [(values[baseline], label) for baseline, label in labels.items() if baseline in values]
            measured = [(f"{number:.3f}", label) for number, label in known if not math.isnan(number)]
            table.add_row(component, name, f"{value:.3f}", *(measured[0] if measured else ("", "")))
            for number, label in measured[1:]:
                table.add_row("", "", "", number, label)
    return table
