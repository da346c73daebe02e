"""The table that ends a training: each figure beside what it has to beat."""

from rich.table import Table

__all__ = ["figures_table"]

# Figure -> the same figure of a guess that needs no network.
TO_BEAT = {
    "voxel_iou": ("mean_shape_iou", "mean training shape"),
    "mask_iou": ("visible_iou", "true visible mask"),
    "occluded_mask_iou": ("occluded_visible_iou", "true visible mask"),
}

MEAN_LATENT = "mean_latent_"  # of any figure of stage 2


def figures_table(title: str, figures: dict[str, dict[str, float]], caption: str) -> Table:
    """A row for each figure of each part."""
    table = Table(title=title, title_justify="left", caption=caption, caption_justify="left")
    for column in ("part", "figure", "value", "to beat", ""):
        table.add_column(column, justify="right" if column in ("value", "to beat") else "left")
    for part, values in figures.items():
        for name, value in values.items():
            if name in {baseline for baseline, _ in TO_BEAT.values()} or name.startswith(MEAN_LATENT):
                continue
            baseline, label = TO_BEAT.get(name, (f"{MEAN_LATENT}{name}", "mean latent"))
            known = baseline in values
            table.add_row(
                part, name, f"{value:.3f}", f"{values[baseline]:.3f}" if known else "", label if known else ""
            )
    return table
