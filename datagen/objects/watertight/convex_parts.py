"""Convex parts for the physics: CoACD on a watertight mesh with fewer faces, cut finer until the hulls fit."""

from dataclasses import dataclass
from typing import Annotated

import coacd
import numpy as np
from jaxtyping import Float, Int
from manifold3d import Manifold, Mesh64, OpType

from datagen.objects.asset.object_asset import ConvexPart
from datagen.objects.mesh.surface_points import face_areas, face_normals
from datagen.objects.watertight.watertight_mesh import (
    WatertightSurface,
    decimated_watertight,
    signed_distance,
)
from shards.settings import Range

__all__ = ["ConvexConfig", "HullFit", "convex_parts", "hull_fit"]

N_FIT_POINTS = 4000
# CoACD's own defaults (20, 2000) double the time and change the fit by less than its noise.
MCTS_NODES, RESOLUTION = 10, 1000


@dataclass(frozen=True, kw_only=True)
class ConvexConfig:
    """CoACD's parameters and when to cut finer."""

    # concavity, tried in turn until the excess is small enough
    thresholds: Annotated[tuple[float, ...], Range(0.001, 1)]
    max_hulls: Annotated[int, Range(1, 10_000)]
    max_hull_verts: Annotated[int, Range(4, 10_000)]
    # a hull gets no more vertices once it is this close to its full form
    hull_tolerance_m: Annotated[float, Range(0, 1)]
    # hull surface outside the watertight mesh (99th percentile) that ends the search
    max_excess_m: Annotated[float, Range(0, 1)]
    # the watertight mesh is lightened to about this many faces first
    max_faces: Annotated[int, Range(100, 100_000_000)]
    mcts_iterations: Annotated[int, Range(1, 10_000)]  # CoACD's search effort per cut; its own default is 150
    seed: Annotated[int, Range(0, 2**31 - 1)]


@dataclass(frozen=True, kw_only=True)
class HullFit:
    """Union of the hulls against the watertight mesh, metres."""

    excess_p99_m: float
    excess_max_m: float
    uncovered_max_m: float


def convex_parts(
    watertight: WatertightSurface, config: ConvexConfig
) -> tuple[tuple[ConvexPart, ...], HullFit]:
    """The decomposition with the smallest excess, and its fit. Deterministic."""
    verts, faces = _lightened(watertight, config.max_faces)
    coacd.set_log_level("error")
    best: tuple[tuple[ConvexPart, ...], HullFit] | None = None
    for threshold in config.thresholds:
        raw = coacd.run_coacd(
            coacd.Mesh(verts, faces),
            threshold=threshold,
            max_convex_hull=config.max_hulls,
            preprocess_mode="off",  # the watertight mesh is a manifold already
            decimate=False,
            mcts_iterations=config.mcts_iterations,
            mcts_nodes=MCTS_NODES,
            resolution=RESOLUTION,
            seed=config.seed,
        )
        parts = tuple(_part(hull_verts, config) for hull_verts, _ in raw)
        fit = hull_fit(watertight, parts)
        if best is None or fit.excess_p99_m < best[1].excess_p99_m:
            best = parts, fit
        if fit.excess_p99_m <= config.max_excess_m:
            break
    if best is None:
        raise ValueError("ConvexConfig.thresholds is empty; expected at least one concavity, e.g. 0.06")
    return best


def _part(verts: Float[np.ndarray, "vert 3"], config: ConvexConfig) -> ConvexPart:
    """The hull of the vertices that matter most: the one farthest outside joins, again and again.

    CoACD's own limit on hull vertices loses millimetres on round shapes.
    """
    verts = np.unique(np.asarray(verts, dtype=np.float64), axis=0)
    first = np.unique([pick(verts[:, axis]) for axis in range(3) for pick in (np.argmin, np.argmax)])
    chosen = list(first)
    far = np.linalg.norm(verts - verts[first].mean(axis=0), axis=1)
    for index in np.argsort(-far, kind="stable"):  # until the start is solid, not flat
        if len(chosen) >= 4 and np.linalg.matrix_rank(verts[chosen] - verts[chosen[0]], tol=1e-6) == 3:
            break
        chosen.append(index)
    while True:
        mesh = Manifold.hull_points(verts[chosen]).to_mesh64()
        hull = ConvexPart(
            verts_obj=np.array(mesh.vert_properties[:, :3], dtype=np.float64),
            faces=np.array(mesh.tri_verts, dtype=np.int64),
        )
        normals = face_normals(hull.verts_obj, hull.faces)
        offsets = (normals * hull.verts_obj[hull.faces[:, 0]]).sum(axis=1)
        outside = (verts @ normals.T - offsets).max(axis=1)
        worst = int(outside.argmax())
        if len(chosen) >= config.max_hull_verts or outside[worst] <= config.hull_tolerance_m:
            return hull
        chosen.append(worst)


def _manifold(verts: Float[np.ndarray, "vert 3"], faces: Int[np.ndarray, "face 3"]) -> Manifold:
    return Manifold(Mesh64(np.ascontiguousarray(verts), np.ascontiguousarray(faces.astype(np.uint64))))


def _lightened(
    watertight: WatertightSurface, max_faces: int
) -> tuple[Float[np.ndarray, "vert 3"], Int[np.ndarray, "face 3"]]:
    """The same mesh with fewer faces, still closed; CoACD's time grows with them."""
    return decimated_watertight(watertight.verts_obj, watertight.faces, max_faces)


def _surface_points(
    verts: Float[np.ndarray, "vert 3"], faces: Int[np.ndarray, "face 3"], rng: np.random.Generator
) -> Float[np.ndarray, "point 3"]:
    cumulative = np.cumsum(face_areas(verts, faces))
    picks = np.searchsorted(cumulative, rng.random(N_FIT_POINTS) * cumulative[-1], side="right")
    barycentric = rng.dirichlet(np.ones(3), N_FIT_POINTS)
    corners = verts[faces[np.minimum(picks, len(faces) - 1)]]
    return np.einsum("pk,pkc->pc", barycentric, corners)


def hull_fit(watertight: WatertightSurface, parts: tuple[ConvexPart, ...]) -> HullFit:
    """How far the union of hulls reaches out of the watertight mesh, and where it falls short of it."""
    rng = np.random.default_rng(0)
    union = Manifold.batch_boolean([_manifold(p.verts_obj, p.faces) for p in parts], OpType.Add)
    mesh = union.to_mesh64()
    union_verts = np.array(mesh.vert_properties[:, :3], dtype=np.float64)
    union_faces = np.array(mesh.tri_verts, dtype=np.int64)
    on_hulls = np.concatenate([_surface_points(union_verts, union_faces, rng), union_verts])
    excess = signed_distance(watertight.verts_obj, watertight.faces, on_hulls)
    on_watertight = _surface_points(watertight.verts_obj, watertight.faces, rng)
    short = signed_distance(union_verts, union_faces, on_watertight)
    return HullFit(
        excess_p99_m=float(max(np.percentile(excess[:N_FIT_POINTS], 99), 0.0)),
        excess_max_m=float(max(excess.max(), 0.0)),
        uncovered_max_m=float(max(short.max(), 0.0)),
    )
