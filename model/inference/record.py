"""reconstruction.json: what a reconstruction was made from and with, and what is known about it."""

import json
import math
import platform
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from model.data.batch import OCCUPANCY_VOXELS, SurfaceTarget
from model.evaluation.surface import SurfaceScore
from model.inference.networks import Networks
from model.inference.reconstruction import Reconstruction
from model.video.frame_choice import FrameChoice

__all__ = ["RECORD", "write_record"]

FORMAT_VERSION = 1
RECORD = "reconstruction.json"


def write_record(
    folder: Path,
    result: Reconstruction,
    networks: Networks,
    *,
    choice: FrameChoice | None,
    truth: SurfaceTarget | None,
    score: SurfaceScore | None,
    seconds: Mapping[str, float],
) -> None:
    """`choice`: how the frames were chosen, None when they were named. `truth` of a clip, and the mesh against it.

    `seconds` by stage.
    """
    record = {
        "format_version": FORMAT_VERSION,
        "input": _input(result),
        "frames": _frames(result, choice),
        "seed": result.seed,
        "checkpoints": [asdict(c) | {"path": str(c.path)} for c in networks.checkpoints],
        "voxels": {"occupied": len(result.voxels), "resolution": OCCUPANCY_VOXELS},
        "surface": _surface(result),
        "scale": _scale(truth),
        "metrics": _metrics(score),
        "notes": list(result.notes),
        "seconds": {name: round(value, 3) for name, value in seconds.items()},
        "computed_on": {
            "device": str(networks.device),
            "threads": torch.get_num_threads(),
            "torch": torch.__version__,
            "machine": platform.machine(),
        },
    }
    text = json.dumps(record, indent=2, allow_nan=False)
    (folder / RECORD).write_text(text + "\n", encoding="utf-8")


def _input(result: Reconstruction) -> dict[str, Any]:
    frames = result.frames
    return {
        "source": frames.source,
        "kind": frames.kind,
        "frames_in_source": frames.n_source_frames,
        "changes": list(frames.changes),
    }


def _frames(result: Reconstruction, choice: FrameChoice | None) -> list[dict[str, Any]]:
    """In the order of the source; pixels are those of the source."""
    scores = [None] * len(result.frames) if choice is None else choice.record()
    records = []
    for frame, crop, window, mask, score in zip(
        result.frames.frames, result.crops, result.windows, result.masks, scores, strict=True
    ):
        source_per_image = np.divide(frame.source_size, frame.image_size)
        corner = source_per_image * window.corner_px
        records.append(
            {
                "index": frame.index,
                "name": frame.name,
                "time_s": None if math.isnan(frame.time_s) else round(frame.time_s, 6),
                "source_size_px": list(frame.source_size),
                "choice": score,
                "crop": {
                    "origin": crop.origin,
                    "corner_px": corner.round(2).tolist(),
                    "side_px": round(float(source_per_image[0]) * window.side_px, 2),
                },
                "mask_share_of_crop": round(float((mask > 0.5).mean()), 4),
            }
        )
    return records


def _surface(result: Reconstruction) -> dict[str, Any] | None:
    if result.surface is None:
        return None
    mesh = result.surface.mesh
    sides = mesh.vertices.max(axis=0) - mesh.vertices.min(axis=0)
    return asdict(result.surface.report) | {
        "watertight_manifold": True,  # extracted_surface raises otherwise
        "bounding_box_sides": sides.round(4).tolist(),
        "exposed_corners": result.surface.exposed_corners,
        "uncolored_vertices": result.surface.uncolored_vertices,
        "dropped_components": result.surface.dropped_components,
    }


def _scale(truth: SurfaceTarget | None) -> dict[str, Any]:
    return {
        "unit": "canonical: the object's longest side is 1 where the network is right; metres are not estimated",
        "axes": "object.glb: Y up, voxels.ply: Z up; the object's own axes as its dataset defines them",
        "metres_per_unit": None if truth is None else truth.object_scale_m,
        "metres_from": None if truth is None else "annotation of the dataset, not the images",
    }


def _metrics(score: SurfaceScore | None) -> dict[str, Any] | None:
    """Of the mesh against the true surface of a clip, as model.evaluation.surface defines them; no alignment."""
    if score is None:
        return None
    rounded = asdict(score.points) | {"normal_deg": score.normal_deg, "color": score.color}
    return {name: round(value, 4) for name, value in rounded.items()}
