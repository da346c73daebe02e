"""Convex parts for the physics: CoACD on a lightened solid, cut finer until the hulls fit."""

from dataclasses import dataclass

import coacd
import numpy as np
from jaxtyping import Float, Int
from manifold3d import Manifold, Mesh64, OpType

from datagen.objects.asset import ConvexPart
from datagen.objects.solids import ClosedSurface, signed_distance
from datagen.objects.surface import face_areas

__all__ = ["ConvexConfig", "HullFit", "convex_parts", "hull_fit"]

N_FIT_POINTS = 4000


@dataclass(frozen=True, kw_only=True)
class ConvexConfig:
    """CoACD's parameters and when to cut finer."""

    thresholds: tuple[float, ...]  # concavity, tried in turn until the excess is small enough
    max_hulls: int
    max_hull_verts: int
    max_excess_m: float  # hull surface outside the solid (99th percentile) that ends the search
    max_faces: int  # the solid is lightened to about this many faces first
    seed: int


@dataclass(frozen=True, kw_only=True)
class HullFit:
    """Union of the hulls against the solid, metres."""

    excess_p99_m: float
    excess_max_m: float
    uncovered_max_m: float


def convex_parts(
    solid: ClosedSurface, config: ConvexConfig
) -> tuple[tuple[ConvexPart, ...], HullFit]:
    """The decomposition with the smallest excess, and its fit. Deterministic."""
    verts, faces = _lightened(solid, config.max_faces)
    coacd.set_log_level("error")
    best: tuple[tuple[ConvexPart, ...], HullFit] | None = None
    for threshold in config.thresholds:
        raw = coacd.run_coacd(
            coacd.Mesh(verts, faces),
            threshold=threshold,
            max_convex_hull=config.max_hulls,
            preprocess_mode="off",  # the solid is a manifold already
            decimate=True,
            max_ch_vertex=config.max_hull_verts,
            seed=config.seed,
        )
        parts = tuple(_part(hull_verts) for hull_verts, _ in raw)
        fit = hull_fit(solid, parts)
        if best is None or fit.excess_p99_m < best[1].excess_p99_m:
            best = parts, fit
        if fit.excess_p99_m <= config.max_excess_m:
            break
    if best is None:
        raise ValueError("ConvexConfig.thresholds is empty; expected at least one concavity, e.g. 0.06")
    return best


def _part(verts: Float[np.ndarray, "vert 3"]) -> ConvexPart:
    """The convex hull proper: CoACD's own triangles are not always outward."""
    mesh = Manifold.hull_points(np.asarray(verts, dtype=np.float64)).to_mesh64()
    return ConvexPart(
        verts_obj=np.array(mesh.vert_properties[:, :3], dtype=np.float64),
        faces=np.array(mesh.tri_verts, dtype=np.int64),
    )


def _manifold(verts: Float[np.ndarray, "vert 3"], faces: Int[np.ndarray, "face 3"]) -> Manifold:
    return Manifold(Mesh64(np.ascontiguousarray(verts), np.ascontiguousarray(faces.astype(np.uint64))))


def _lightened(
    solid: ClosedSurface, max_faces: int
) -> tuple[Float[np.ndarray, "vert 3"], Int[np.ndarray, "face 3"]]:
    """The same solid with fewer faces, still closed; CoACD's time grows with them."""
    body = _manifold(solid.verts_obj, solid.faces)
    longest = float(np.ptp(solid.verts_obj, axis=0).max())
    tolerance = 5e-4 * longest
    while body.num_tri() > max_faces and tolerance < 2.5e-3 * longest:
        lighter = body.simplify(tolerance)
        if lighter.is_empty() or lighter.volume() < 0.9 * body.volume():
            break
        body, tolerance = lighter, tolerance * 1.5
    mesh = body.to_mesh64()
    return np.array(mesh.vert_properties[:, :3], dtype=np.float64), np.array(mesh.tri_verts, dtype=np.int64)


def _surface_points(
    verts: Float[np.ndarray, "vert 3"], faces: Int[np.ndarray, "face 3"], rng: np.random.Generator
) -> Float[np.ndarray, "point 3"]:
    cumulative = np.cumsum(face_areas(verts, faces))
    picks = np.searchsorted(cumulative, rng.random(N_FIT_POINTS) * cumulative[-1], side="right")
    barycentric = rng.dirichlet(np.ones(3), N_FIT_POINTS)
    corners = verts[faces[np.minimum(picks, len(faces) - 1)]]
    return np.einsum("pk,pkc->pc", barycentric, corners)


def hull_fit(solid: ClosedSurface, parts: tuple[ConvexPart, ...]) -> HullFit:
    """How far the union of hulls reaches out of the solid, and where it falls short of it."""
    rng = np.random.default_rng(0)
    union = Manifold.batch_boolean([_manifold(p.verts_obj, p.faces) for p in parts], OpType.Add)
    mesh = union.to_mesh64()
    union_verts = np.array(mesh.vert_properties[:, :3], dtype=np.float64)
    union_faces = np.array(mesh.tri_verts, dtype=np.int64)
    on_hulls = np.concatenate([_surface_points(union_verts, union_faces, rng), union_verts])
    excess = signed_distance(solid.verts_obj, solid.faces, on_hulls)
    on_solid = _surface_points(solid.verts_obj, solid.faces, rng)
    short = signed_distance(union_verts, union_faces, on_solid)
    return HullFit(
        excess_p99_m=float(max(np.percentile(excess[:N_FIT_POINTS], 99), 0.0)),
        excess_max_m=float(max(excess.max(), 0.0)),
        uncovered_max_m=float(max(short.max(), 0.0)),
    )
