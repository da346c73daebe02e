"""Distance and F-score between a predicted mesh and the true surface of an object, in the object's own frame.

Protocol: both in the canonical frame, scaled to metres by `object_scale_m`; no alignment of any kind (the frames are
the same). The mesh is sampled evenly by area with a generator of its own; the truth are the `surface_points` of the
shard. With d_ab the distance of each point of a to the nearest of b:

    chamfer_cm  mean d_found,true + mean d_true,found, centimetres, unsquared (as MagicHOI, FORMATS 6.1)
    f_score     2 P R / (P + R), percent; P, R the shares of found and of true points within the threshold (<=)
    normal_deg  mean angle between the normal of a true point and that of the nearest found point
    color       mean absolute difference over the channels, sRGB 0..1, of the same pairs

Two samples of one surface never agree exactly: `chamfer_cm` of a perfect mesh is about the spacing of the points.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from model.data.batch import SurfaceTarget
from model.surface.mesh import SurfaceMesh

__all__ = ["PointScore", "SampledMesh", "SurfaceScore", "point_score", "sample_mesh", "surface_score"]


@dataclass(frozen=True, kw_only=True)
class SampledMesh:
    """Points spread over a mesh."""

    points: Float[np.ndarray, "point 3"]
    normals: Float[np.ndarray, "point 3"]  # of the faces, outward
    colors: Float[np.ndarray, "point 3"]  # sRGB, 0..1


@dataclass(frozen=True, kw_only=True)
class PointScore:
    """How well found points agree with true ones."""

    chamfer_cm: float
    f_5mm: float  # percent
    f_10mm: float  # percent


@dataclass(frozen=True, kw_only=True)
class SurfaceScore:
    """How well a coloured mesh agrees with an object."""

    points: PointScore
    normal_deg: float
    color: float


def sample_mesh(mesh: SurfaceMesh, count: int, rng: np.random.Generator) -> SampledMesh:
    """`count` points, uniform over the area, with interpolated colours."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    face: Int[np.ndarray, " point"] = rng.choice(len(area), count, p=area / area.sum())
    root, along = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1.0 - root, root * (1.0 - along), root * along], axis=1)
    return SampledMesh(
        points=np.einsum("pc,pcx->px", weights, corners[face]),
        normals=cross[face] / area[face, None],
        colors=np.einsum("pc,pcx->px", weights, mesh.colors[mesh.faces[face]].astype(np.float64)),
    )


def point_score(found_m: Float[np.ndarray, "found 3"], true_m: Float[np.ndarray, "true 3"]) -> PointScore:
    """Score of points in metres; where nothing was found, an infinite distance and no F-score."""
    if not len(found_m) or not len(true_m):
        return PointScore(chamfer_cm=float("inf"), f_5mm=0.0, f_10mm=0.0)
    to_true = np.asarray(KDTree(true_m).query(found_m)[0])
    to_found = np.asarray(KDTree(found_m).query(true_m)[0])
    return PointScore(
        chamfer_cm=100.0 * float(to_true.mean() + to_found.mean()),
        f_5mm=_f_score(to_true, to_found, 0.005),
        f_10mm=_f_score(to_true, to_found, 0.010),
    )


def surface_score(
    mesh: SurfaceMesh, truth: SurfaceTarget, samples: int, rng: np.random.Generator
) -> SurfaceScore:
    """Score of a mesh in the canonical frame."""
    found = sample_mesh(mesh, samples, rng)
    nearest = KDTree(found.points).query(truth.points)[1]
    cosine = np.einsum("px,px->p", found.normals[nearest], truth.normals).clip(-1.0, 1.0)
    scale = truth.object_scale_m
    return SurfaceScore(
        points=point_score(found.points * scale, truth.points * scale),
        normal_deg=float(np.rad2deg(np.arccos(cosine)).mean()),
        color=float(np.abs(found.colors[nearest] - truth.colors / 255.0).mean()),
    )


def _f_score(
    to_true: Float[np.ndarray, " found"], to_found: Float[np.ndarray, " true"], threshold_m: float
) -> float:
    precision, recall = float((to_true <= threshold_m).mean()), float((to_found <= threshold_m).mean())
    return 100.0 * 2.0 * precision * recall / (precision + recall) if precision + recall else 0.0
