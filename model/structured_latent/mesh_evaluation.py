"""From decoded voxels to meshes, their scores and their images."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.data.batch import SurfaceTarget
from model.errors import ModelError
from model.evaluation.surface import SurfaceScore, surface_score
from model.networks.sparse.tensor import SparseTensor
from model.structured_latent.prediction import decoded_fields
from model.surface.extraction import ExtractionConfig, extract_surface
from model.surface.mesh import MeshReport, SurfaceMesh, check_manifold

__all__ = ["MeshEvaluationConfig", "ScoredMesh", "mean_scores", "scored_mesh"]


@dataclass(frozen=True, kw_only=True)
class MeshEvaluationConfig:
    """How decoded objects are measured."""

    extraction: ExtractionConfig
    samples: int  # points on the mesh


@dataclass(frozen=True, kw_only=True)
class ScoredMesh:
    """The mesh of a decoded object and how it compares; no mesh where the decoder sees nothing inside."""

    mesh: SurfaceMesh | None
    score: SurfaceScore | None
    report: (
        MeshReport | None
    )  # None: it is not closed, oriented and manifold (model.surface.mesh.check_manifold)
    largest_chamfer_cm: float  # both ways across the object's cube: what having no mesh costs


def scored_mesh(
    decoded: SparseTensor, sample: int, truth: SurfaceTarget, config: MeshEvaluationConfig
) -> ScoredMesh:
    """The surface of one sample against its truth; points on the mesh are drawn with a fixed seed."""
    largest_chamfer_cm = 100.0 * 2.0 * math.sqrt(3.0) * truth.object_scale_m
    try:
        mesh = extract_surface(decoded_fields(decoded, sample), config.extraction).mesh
    except ModelError:  # no voxel, nothing inside, or numbers that are not finite: counted by `mean_scores`
        return ScoredMesh(mesh=None, score=None, report=None, largest_chamfer_cm=largest_chamfer_cm)
    try:
        report = check_manifold(mesh)
    except ModelError:
        report = None
    score = surface_score(mesh, truth, config.samples, np.random.default_rng(0))
    return ScoredMesh(mesh=mesh, score=score, report=report, largest_chamfer_cm=largest_chamfer_cm)


def mean_scores(meshes: Sequence[ScoredMesh]) -> dict[str, float]:
    """Means over objects. One without a mesh counts as F-score 0 and as far off as its cube allows, and is counted.

    f_5mm, f_10mm and manifold are percent, chamfer_cm is MagicHOI's sum, color is sRGB 0..1; handles (genus) and
    components, of manifold meshes only, tell ragged surfaces that the F-score does not see. NaN: of no mesh at all.
    """
    found = [mesh.score for mesh in meshes if mesh.score is not None]
    reports = [mesh.report for mesh in meshes if mesh.report is not None]
    count = len(meshes)
    chamfer_cm = [m.largest_chamfer_cm if m.score is None else m.score.points.chamfer_cm for m in meshes]
    return {
        "f_5mm": _mean([score.points.f_5mm for score in found], count),
        "f_10mm": _mean([score.points.f_10mm for score in found], count),
        "chamfer_cm": _mean(chamfer_cm, count),
        "normal_deg": _mean([score.normal_deg for score in found], len(found)),
        "color_error": _mean([score.color for score in found], len(found)),
        "manifold": 100.0 * _mean([1.0] * len(reports), count),
        "handles": _mean([float(report.genus) for report in reports], len(reports)),
        "components": _mean([float(report.components) for report in reports], len(reports)),
        "without_mesh": float(count - len(found)),
    }


def _mean(values: Sequence[float], count: int) -> float:
    return math.fsum(values) / count if count else math.nan
