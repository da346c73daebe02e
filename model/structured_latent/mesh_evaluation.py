"""From decoded voxels to meshes, their scores and their images."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from model.data.batch import SurfaceTarget
from model.errors import ModelError
from model.evaluation.surface import SurfaceScore, surface_score
from model.networks.sparse.tensor import SparseTensor
from model.structured_latent.prediction import decoded_fields
from model.surface.extraction import ExtractionConfig, extract_surface
from model.surface.mesh import MeshReport, SurfaceMesh, check_manifold
from shards.settings import Range

__all__ = ["MESH_METRICS", "MeshEvaluationConfig", "ScoredMesh", "numbers_of_objects", "scored_mesh"]

MESH_METRICS = (
    "f_5mm",  # percent
    "f_10mm",
    "chamfer_cm",  # MagicHOI's sum
    "normal_deg",  # of objects that have a mesh
    "color_error",  # sRGB 0..1, likewise
    "manifold",  # percent
    "handles",  # genus, of manifold meshes: tells ragged surfaces that the F-score does not see
    "components",  # likewise
    "without_mesh",  # percent
)


@dataclass(frozen=True, kw_only=True)
class MeshEvaluationConfig:
    """How decoded objects are measured."""

    extraction: ExtractionConfig
    samples: Annotated[int, Range(1, 100_000_000)]  # points on the mesh


@dataclass(frozen=True, kw_only=True)
class ScoredMesh:
    """The mesh of a decoded object and how it compares; no mesh where the decoder sees nothing inside."""

    mesh: SurfaceMesh | None
    score: SurfaceScore | None
    report: (
        MeshReport | None
    )  # None: not watertight, oriented and manifold (model.surface.mesh.check_manifold)
    largest_chamfer_cm: float  # both ways across the object's cube: what having no mesh costs

    def numbers(self) -> dict[str, float]:
        """Its numbers in MESH_METRICS, without those that it has none of.

        No mesh counts as F-score 0 and as far off as the cube allows.
        """
        if self.score is None:
            nothing = {"f_5mm": 0.0, "f_10mm": 0.0, "manifold": 0.0, "without_mesh": 100.0}
            return nothing | {"chamfer_cm": self.largest_chamfer_cm}
        points = self.score.points
        numbers = {
            "f_5mm": points.f_5mm,
            "f_10mm": points.f_10mm,
            "chamfer_cm": points.chamfer_cm,
            "normal_deg": self.score.normal_deg,
            "color_error": self.score.color,
            "manifold": 0.0 if self.report is None else 100.0,
            "without_mesh": 0.0,
        }
        if self.report is None:
            return numbers
        return numbers | {"handles": float(self.report.genus), "components": float(self.report.components)}


def scored_mesh(
    decoded: SparseTensor, sample: int, truth: SurfaceTarget, config: MeshEvaluationConfig
) -> ScoredMesh:
    """The surface of one sample against its truth; points on the mesh are drawn with a fixed seed."""
    largest_chamfer_cm = 100.0 * 2.0 * math.sqrt(3.0) * truth.object_scale_m
    try:
        mesh = extract_surface(decoded_fields(decoded, sample), config.extraction).mesh
    except ModelError:  # no voxel, nothing inside, or numbers that are not finite
        return ScoredMesh(mesh=None, score=None, report=None, largest_chamfer_cm=largest_chamfer_cm)
    try:
        report = check_manifold(mesh)
    except ModelError:
        report = None
    score = surface_score(mesh, truth, config.samples, np.random.default_rng(0))
    return ScoredMesh(mesh=mesh, score=score, report=report, largest_chamfer_cm=largest_chamfer_cm)


def numbers_of_objects(meshes: Mapping[str, ScoredMesh], prefix: str = "") -> dict[str, dict[str, float]]:
    """The numbers of one mesh for each object, by metric and object, as `Measurements.of_objects` holds them."""
    numbers = {uid: mesh.numbers() for uid, mesh in meshes.items()}
    return {
        f"{prefix}{name}": {uid: of[name] for uid, of in numbers.items() if name in of}
        for name in MESH_METRICS
    }
