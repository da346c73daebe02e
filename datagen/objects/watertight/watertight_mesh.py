"""A closed surface for any mesh: its own where it is closed, else a fine level set."""

from dataclasses import dataclass
from typing import Annotated

import fast_simplification
import igl
import numpy as np
from jaxtyping import Float, Int
from manifold3d import Error, Manifold, Mesh64, OpType

from datagen.objects.errors import ObjectError
from datagen.objects.mesh.surface_points import face_areas, face_normals
from datagen.objects.watertight.level_set import LevelSetConfig, level_set_surface
from shards.settings import Range

__all__ = [
    "WatertightConfig",
    "WatertightSurface",
    "decimated_watertight",
    "signed_distance",
    "watertight_surface",
]

MAX_COMPONENTS = 400  # more are remeshed: their union costs more than a level set


@dataclass(frozen=True, kw_only=True)
class WatertightConfig:
    """How closed surfaces are made."""

    level_set: LevelSetConfig
    tolerance_m: Annotated[float, Range(0, 1)]  # simplification moves the surface by less than this
    # quadric decimation beyond this, where the surface stays closed
    max_faces: Annotated[int, Range(100, 100_000_000)]


@dataclass(frozen=True, kw_only=True)
class WatertightSurface:
    """A 2-manifold without boundary, outward faces, object frame, metres."""

    verts_obj: Float[np.ndarray, "vert 3"]
    faces: Int[np.ndarray, "face 3"]
    watertight_source: bool  # made of the drawn triangles, not of a level set


def watertight_surface(
    verts_obj: Float[np.ndarray, "vert 3"],
    faces: Int[np.ndarray, "face 3"],
    config: WatertightConfig,
    *,
    source: object,
) -> WatertightSurface:
    """Closed version of a mesh with outward faces. ObjectError where nothing watertight mesh is left."""
    watertight = _union_of_closed_parts(verts_obj, faces)
    watertight_source = watertight is not None
    if watertight is None:
        level_verts, level_faces = level_set_surface(verts_obj, faces, config.level_set)
        watertight = _manifold(level_verts, level_faces)
        if watertight is not None:
            watertight = _without_voids_and_crumbs(watertight, config.level_set.voxel_m(verts_obj))
    if watertight is None or watertight.is_empty() or watertight.volume() <= 0:
        raise ObjectError(
            source,
            "encloses no volume",
            expected="an object with some thickness",
            action="Check the mesh in a viewer; give sheets a thickness.",
        )
    mesh = _simplified(watertight, config).to_mesh64()
    closed_verts, closed_faces = decimated_watertight(
        np.array(mesh.vert_properties[:, :3], dtype=np.float64),
        np.array(mesh.tri_verts, dtype=np.int64),
        config.max_faces,
    )
    return WatertightSurface(
        verts_obj=closed_verts,
        faces=closed_faces,
        watertight_source=watertight_source,
    )


def _manifold(verts: Float[np.ndarray, "vert 3"], faces: Int[np.ndarray, "face 3"]) -> Manifold | None:
    """The mesh as a manifold, or None where its edges do not pair up."""
    if len(faces) < 4:
        return None
    mesh = Mesh64(np.ascontiguousarray(verts), np.ascontiguousarray(faces.astype(np.uint64)))
    watertight = Manifold(mesh)
    return watertight if watertight.status() == Error.NoError and not watertight.is_empty() else None


def _union_of_closed_parts(
    verts: Float[np.ndarray, "vert 3"], faces: Int[np.ndarray, "face 3"]
) -> Manifold | None:
    """Union of the connected parts if each is closed by itself and cleanly oriented."""
    n_parts, part_of_face = igl.facet_components(np.ascontiguousarray(faces))
    if n_parts > MAX_COMPONENTS:
        return None
    parts = []
    for part in range(n_parts):
        used, local = np.unique(faces[part_of_face == part], return_inverse=True)
        local = local.reshape(-1, 3)
        watertight = _manifold(verts[used], local)
        if watertight is None:
            return None
        if watertight.volume() < 0:  # a shell that faces inward is a cavity: filled
            watertight = _manifold(verts[used], local[:, ::-1])
        if watertight is None or not _is_clean(verts[used], local):
            return None
        parts.append(watertight)
    union = Manifold.batch_boolean(parts, OpType.Add) if len(parts) > 1 else parts[0]
    return None if union.is_empty() else _without_voids_and_crumbs(union, 0.0)


def _is_clean(verts: Float[np.ndarray, "vert 3"], faces: Int[np.ndarray, "face 3"]) -> bool:
    """No part of the surface lies inside itself: the winding number steps 0 -> +-1 everywhere."""
    normals = face_normals(verts, faces)
    centers = verts[faces].mean(axis=1)
    gap = 1e-5 * np.ptp(verts, axis=0).max()
    outside = np.abs(igl.fast_winding_number(verts, faces, centers + gap * normals))
    inside = np.abs(igl.fast_winding_number(verts, faces, centers - gap * normals))
    low, high = np.minimum(inside, outside), np.maximum(inside, outside)
    areas = face_areas(verts, faces)
    bad = (low > 0.2) | (np.abs(high - 1.0) > 0.2)
    return float(areas[bad].sum()) <= 1e-3 * float(areas.sum())


def _without_voids_and_crumbs(watertight: Manifold, voxel_m: float) -> Manifold:
    """Drop inner cavities (negative volume) and specks of less than eight voxels."""
    components = watertight.decompose()
    volumes = [component.volume() for component in components]
    least = max(8 * voxel_m**3, 1e-9 * max(volumes))
    kept = [component for component, volume in zip(components, volumes) if volume > least]
    return Manifold.compose(kept)


def _simplified(watertight: Manifold, config: WatertightConfig) -> Manifold:
    watertight = watertight.as_original()
    simple = watertight.simplify(config.tolerance_m)
    return watertight if simple.is_empty() or simple.volume() <= 0 else simple


def decimated_watertight(
    verts: Float[np.ndarray, "vert 3"], faces: Int[np.ndarray, "face 3"], max_faces: int
) -> tuple[Float[np.ndarray, "out_vert 3"], Int[np.ndarray, "out_face 3"]]:
    """Quadric decimation of a closed surface; given back unchanged where it would not stay closed."""
    if len(faces) <= max_faces:
        return verts, faces
    volume = _signed_volume(verts, faces)
    light_verts, light_faces = fast_simplification.simplify(
        verts.astype(np.float32), faces.astype(np.int32), target_count=max_faces, agg=5
    )
    light = _manifold(light_verts.astype(np.float64), light_faces.astype(np.int64))
    if light is None or abs(light.volume() - volume) > 0.03 * volume:
        return verts, faces
    mesh = light.to_mesh64()
    return np.array(mesh.vert_properties[:, :3], dtype=np.float64), np.array(mesh.tri_verts, dtype=np.int64)


def _signed_volume(verts: Float[np.ndarray, "vert 3"], faces: Int[np.ndarray, "face 3"]) -> float:
    a, b, c = (verts[faces[:, k]] for k in range(3))
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6.0)


def signed_distance(
    verts: Float[np.ndarray, "vert 3"],
    faces: Int[np.ndarray, "face 3"],
    points: Float[np.ndarray, "point 3"],
) -> Float[np.ndarray, " point"]:
    """Exact distance to the surface, negative inside (generalised winding number > 1/2)."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    squared, _, _ = igl.point_mesh_squared_distance(points, verts, faces)
    inside = igl.fast_winding_number(verts, faces, points) > 0.5
    return np.where(inside, -1.0, 1.0) * np.sqrt(squared)
