"""From decoded voxels to meshes, their scores and their pictures."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.errors import ModelError
from model.evaluation.surface import SurfaceScore, surface_score
from model.networks.sparse.tensor import SparseTensor
from model.sample import ObjectSurface
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


def scored_mesh(
    decoded: SparseTensor, sample: int, truth: ObjectSurface, config: MeshEvaluationConfig
) -> ScoredMesh:
    """The surface of one sample against its truth; points on the mesh are drawn with a fixed seed."""
    try:
        mesh = extract_surface(decoded_fields(decoded, sample), config.extraction).mesh
    except ModelError:  # no voxel, nothing inside, or numbers that are not finite: counted by `mean_scores`
        return ScoredMesh(mesh=None, score=None, report=None)
    try:
        report = check_manifold(mesh)
    except ModelError:
        report = None
    score = surface_score(mesh, truth, config.samples, np.random.default_rng(0))
    return ScoredMesh(mesh=mesh, score=score, report=report)


def mean_scores(meshes: Sequence[ScoredMesh]) -> dict[str, float]:
    """Means over objects. An object without a mesh counts as F-score 0 and infinite distance, and is counted.

    f_5mm, f_10mm and manifold are percent, chamfer_cm is MagicHOI's sum, color is sRGB 0..1; handles (genus) and
    components, of manifold meshes only, tell ragged surfaces that the F-score does not see.
    """
    found = [mesh.score for mesh in meshes if mesh.score is not None]
    count = max(len(meshes), 1)
    missing = len(meshes) - len(found)
    reports = [mesh.report for mesh in meshes if mesh.report is not None]
    return {
        "f_5mm": sum(score.points.f_5mm for score in found) / count,
        "f_10mm": sum(score.points.f_10mm for score in found) / count,
        "chamfer_cm": float("inf") if missing else sum(score.points.chamfer_cm for score in found) / count,
        "normal_deg": sum(score.normal_deg for score in found) / max(len(found), 1),
        "color_error": sum(score.color for score in found) / max(len(found), 1),
        "manifold": 100.0 * len(reports) / count,
        "handles": sum(report.genus for report in reports) / max(len(reports), 1),
        "components": sum(report.components for report in reports) / max(len(reports), 1),
        "without_mesh": float(missing),
    }
