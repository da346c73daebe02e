"""The table shows a metric next to its baseline, and only there."""

import math

from rich.console import Console

from model.cli.metrics_table import metrics_table


def test_a_baseline_is_a_column_and_no_row_of_its_own() -> None:
    metrics = {
        "vae": {"voxel_iou": 0.7},
        "stage_one": {
            "voxel_iou": 0.66,
            "mean_shape_iou": 0.32,
            "mask_iou": 0.71,
            "visible_iou": 0.87,
            "found_visible_iou": 0.68,
            "occluded_mask_iou": 0.5,
            "occluded_visible_iou": 0.4,
            "occluded_found_visible_iou": math.nan,
        },
    }
    console = Console(width=120)
    with console.capture() as capture:
        console.print(metrics_table("tiny: metrics", metrics, "caption"))
    lines = capture.get().splitlines()
    assert not any("mean_shape_iou" in line or "visible_iou" in line for line in lines)
    (vae,) = [line for line in lines if "vae" in line]
    assert "0.700" in vae
    assert "mean training shape" not in vae
    (shape,) = [line for line in lines if "0.660" in line]
    assert "0.320" in shape
    assert "mean training shape" in shape
    (found,) = [index for index, line in enumerate(lines) if "0.710" in line]
    assert "0.680" in lines[found]
    assert "as the hand encoder detects it" in lines[found]
    assert "0.870" in lines[found + 1]
    assert "the true one" in lines[found + 1]
    (occluded,) = [line for line in lines if "0.500" in line]
    assert "0.400" in occluded  # what was not measured has no row
    assert "nan" not in capture.get()


def test_the_baseline_of_stage_two_is_the_mean_latent() -> None:
    console = Console(width=120)
    with console.capture() as capture:
        console.print(
            metrics_table("t", {"slat_flow": {"f_5mm": 98.9, "mean_latent_f_5mm": 92.1}}, "caption")
        )
    rows = [line for line in capture.get().splitlines() if "slat_flow" in line]
    assert len(rows) == 1
    assert "98.900" in rows[0]
    assert "92.100" in rows[0]
    assert "mean latent" in rows[0]
