"""Triangles that face outward, each drawn once."""

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from trimesh import Trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector

from datagen.objects.mesh.object_mesh import ObjectMesh
from datagen.objects.mesh.surface_points import face_areas, face_normals

__all__ = ["outward_mesh", "ray_intersector"]

RAYS_PER_PATCH = 96
CLEAR_MARGIN = 0.02  # escape rates closer than this do not tell the sides apart


def ray_intersector(
    verts: Float[np.ndarray, "vert 3"], faces: Int[np.ndarray, "face 3"]
) -> RayMeshIntersector:
    """Embree over a triangle mesh."""
    return RayMeshIntersector(Trimesh(verts, faces, process=False))


def outward_mesh(mesh: ObjectMesh) -> ObjectMesh:
    """The same surface with repeated triangles removed and every patch facing outward.

    A patch is what manifold edges connect. Its outside is the side from which more rays escape;
    where both sides are alike (a leaf) the file's own orientation stays. UVs and colours move with corners.
    """
    mesh = _without_repeats(mesh)
    oriented, patch = igl.bfs_orient(np.ascontiguousarray(mesh.faces, dtype=np.int64))
    oriented, patch = oriented.astype(np.int64), patch.astype(np.int64)
    flipped = _is_mirrored(mesh.faces, oriented)
    areas = face_areas(mesh.verts_obj, mesh.faces)
    n_patches = int(patch.max()) + 1
    # Within a patch the orientation that covers more area in the file stands for the file's.
    mirrored_area = np.bincount(patch, areas * flipped, n_patches)
    file_disagrees = mirrored_area > 0.5 * np.bincount(patch, areas, n_patches)
    flipped ^= file_disagrees[patch]
    inward = _inward_patches(mesh, patch, flipped, areas)
    flipped ^= inward[patch]
    order = np.where(flipped[:, None], [[2, 1, 0]], [[0, 1, 2]])
    return mesh.with_corners(
        lambda rows: np.take_along_axis(rows, order[..., None], axis=1),
        faces=np.take_along_axis(mesh.faces, order, axis=1),
    )


def _without_repeats(mesh: ObjectMesh) -> ObjectMesh:
    """Triangles over the same three vertices are kept once: drawn twice they flicker."""
    _, first = np.unique(np.sort(mesh.faces, axis=1), axis=0, return_index=True)
    kept = np.sort(first)
    return mesh.with_corners(
        lambda rows: rows[kept], faces=mesh.faces[kept], face_material=mesh.face_material[kept]
    )


def _is_mirrored(
    faces: Int[np.ndarray, "face 3"], other: Int[np.ndarray, "face 3"]
) -> Bool[np.ndarray, " face"]:
    """True where `other` runs through the same three vertices the other way round."""
    same = np.zeros(len(faces), dtype=bool)
    for shift in range(3):
        same |= (np.roll(faces, shift, axis=1) == other).all(axis=1)
    return ~same


def _inward_patches(
    mesh: ObjectMesh,
    patch: Int[np.ndarray, " face"],
    flipped: Bool[np.ndarray, " face"],
    areas: Float[np.ndarray, " face"],
) -> Bool[np.ndarray, " patch"]:
    """True for patches whose back lets clearly more rays escape than their front."""
    rng = np.random.default_rng(0)
    normals = face_normals(mesh.verts_obj, mesh.faces) * np.where(flipped, -1.0, 1.0)[:, None]
    n_patches = int(patch.max()) + 1
    order = np.argsort(patch, kind="stable")
    starts = np.searchsorted(patch[order], np.arange(n_patches + 1))
    faces = np.concatenate(
        [_area_weighted(order[starts[k] : starts[k + 1]], areas, rng) for k in range(n_patches)]
    )
    barycentric = rng.dirichlet(np.ones(3), len(faces))
    points = np.einsum("pk,pkc->pc", barycentric, mesh.verts_obj[mesh.faces[faces]])
    directions = rng.standard_normal((len(faces), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    toward_front = np.sign((directions * normals[faces]).sum(axis=1, keepdims=True))
    directions *= np.where(toward_front == 0, 1.0, toward_front)
    gap = 1e-4 * np.ptp(mesh.verts_obj, axis=0).max()
    rays = ray_intersector(mesh.verts_obj, mesh.faces)
    escapes = []
    for side in (1.0, -1.0):
        origins = points + side * gap * normals[faces]
        free = ~rays.intersects_any(origins, side * directions)
        escapes.append(free.reshape(n_patches, RAYS_PER_PATCH).mean(axis=1))
    return escapes[1] > escapes[0] + CLEAR_MARGIN


def _area_weighted(
    faces: Int[np.ndarray, " face"], areas: Float[np.ndarray, " all_face"], rng: np.random.Generator
) -> Int[np.ndarray, " ray"]:
    cumulative = np.cumsum(areas[faces])
    picks = np.searchsorted(cumulative, rng.random(RAYS_PER_PATCH) * cumulative[-1], side="right")
    return faces[np.minimum(picks, len(faces) - 1)]
