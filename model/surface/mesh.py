"""A coloured triangle mesh, and the proof that it bounds a watertight mesh."""

from dataclasses import dataclass

import manifold3d
import numpy as np
from jaxtyping import Float, Float32, Int, Int32
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from model.errors import ModelError

__all__ = [
    "MeshReport",
    "SurfaceMesh",
    "as_manifold",
    "check_manifold",
    "face_components",
    "face_volumes",
    "vertex_normals",
]


@dataclass(frozen=True, kw_only=True)
class SurfaceMesh:
    """Triangles in the canonical frame (Z up, [-0.5, 0.5]^3), counter-clockwise as seen from outside."""

    vertices: Float32[np.ndarray, "vertex 3"]
    faces: Int32[np.ndarray, "face 3"]
    colors: Float32[np.ndarray, "vertex 3"]  # sRGB, 0..1


@dataclass(frozen=True, kw_only=True)
class MeshReport:
    """What a checked mesh is; lengths in the unit of its vertices."""

    vertices: int
    faces: int
    components: int
    genus: int  # handles, summed over the components
    volume: float
    area: float


def check_manifold(mesh: SurfaceMesh) -> MeshReport:
    """Closed, oriented, manifold, of positive volume, accepted by Manifold. ModelError names what is not so."""
    faces = mesh.faces
    if not len(faces):
        raise _not_watertight("it has no face")
    if faces.min() < 0 or faces.max() >= len(mesh.vertices):
        raise _not_watertight(f"faces name vertices {faces.min()}..{faces.max()} of {len(mesh.vertices)}")
    if not np.isfinite(mesh.vertices).all():
        raise _not_watertight(
            f"{np.count_nonzero(~np.isfinite(mesh.vertices).all(1))} vertices are not finite"
        )
    _check_edges(faces)
    unused = len(mesh.vertices) - len(np.unique(faces))
    if unused:
        raise _not_watertight(f"{unused} vertices belong to no face")
    rings = _vertex_rings(faces)
    if rings != len(mesh.vertices):
        raise _not_watertight(f"{rings - len(mesh.vertices)} vertices join sheets that touch in a point only")
    as_manifold(mesh)
    volume = float(face_volumes(mesh).sum())
    if volume <= 0.0:
        raise _not_watertight(f"its volume is {volume:.3g}: it is inside out")
    components = int(face_components(faces).max()) + 1
    euler = len(mesh.vertices) - len(faces) // 2
    return MeshReport(
        vertices=len(mesh.vertices),
        faces=len(faces),
        components=components,
        genus=components - euler // 2,
        volume=volume,
        area=0.5 * float(np.linalg.norm(_face_crosses(mesh), axis=1).sum()),
    )


def as_manifold(mesh: SurfaceMesh) -> manifold3d.Manifold:
    """The mesh, without colours, for the Manifold library. ModelError: it does not take it."""
    vertices = np.array(mesh.vertices, order="C")  # Manifold refuses read-only arrays
    watertight = manifold3d.Manifold(
        manifold3d.Mesh(vertices, np.array(mesh.faces, dtype=np.uint32, order="C"))
    )
    if watertight.status() != manifold3d.Error.NoError:
        raise _not_watertight(f"Manifold says {watertight.status().name}")
    return watertight


def face_components(faces: Int[np.ndarray, "face 3"]) -> Int32[np.ndarray, " face"]:
    """Number of the connected component of each face, 0, 1, ...; faces are joined by common vertices."""
    size = int(faces.max()) + 1
    a, b = faces[:, [0, 1]].reshape(-1), faces[:, [1, 2]].reshape(-1)
    _, of_vertex = connected_components(
        coo_matrix((np.ones(len(a), dtype=bool), (a, b)), shape=(size, size)), False
    )
    return np.unique(of_vertex[faces[:, 0]], return_inverse=True)[1].astype(np.int32)


def face_volumes(mesh: SurfaceMesh) -> Float[np.ndarray, " face"]:
    """Signed volumes of the tetrahedra between the origin and each face; a closed mesh's volume is their sum."""
    return (mesh.vertices[mesh.faces[:, 0]] * _face_crosses(mesh)).sum(axis=1) / 6.0


def _face_crosses(mesh: SurfaceMesh) -> Float[np.ndarray, "face 3"]:
    """Outward normals, twice as long as the faces' areas."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return np.cross(b - a, c - a)


def vertex_normals(mesh: SurfaceMesh) -> Float32[np.ndarray, "vertex 3"]:
    """Outward unit normals, faces weighted by area; zero where the area around a vertex is zero."""
    corner = mesh.faces.reshape(-1)
    spread = np.repeat(_face_crosses(mesh), 3, axis=0)
    total = np.stack([np.bincount(corner, spread[:, k], len(mesh.vertices)) for k in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return (total / np.where(length > 0.0, length, 1.0)).astype(np.float32)


def _check_edges(faces: Int32[np.ndarray, "face 3"]) -> None:
    start, stop = faces.astype(np.int64).reshape(-1), np.roll(faces, -1, axis=1).astype(np.int64).reshape(-1)
    if (start == stop).any():
        raise _not_watertight(f"{np.count_nonzero(start == stop)} faces use a vertex twice")
    size = int(faces.max()) + 1
    both = np.minimum(start, stop) * size + np.maximum(start, stop)
    _, inverse, times = np.unique(both, return_inverse=True, return_counts=True)
    if (times != 2).any():
        raise _not_watertight(
            f"{np.count_nonzero(times == 1)} edges have one face and {np.count_nonzero(times > 2)} more than two"
        )
    upward = np.bincount(inverse.reshape(-1), start < stop)
    if (upward != 1).any():
        raise _not_watertight(
            f"the two faces of {np.count_nonzero(upward != 1)} edges are turned against each other"
        )


def _vertex_rings(faces: Int32[np.ndarray, "face 3"]) -> int:
    """Rings of faces around vertices, where each edge has two opposite faces; one per vertex is manifold."""
    corner = np.arange(faces.size).reshape(-1, 3)
    start, stop = faces.astype(np.int64).reshape(-1), np.roll(faces, -1, axis=1).astype(np.int64).reshape(-1)
    at_start, at_stop = corner.reshape(-1), np.roll(corner, -1, axis=1).reshape(-1)
    size = int(faces.max()) + 1
    here, there = np.argsort(start * size + stop), np.argsort(stop * size + start)
    a = np.concatenate([at_start[here], at_stop[here]])
    b = np.concatenate([at_stop[there], at_start[there]])
    graph = coo_matrix((np.ones(len(a), dtype=bool), (a, b)), shape=(faces.size, faces.size))
    return int(connected_components(graph, directed=False)[0])


def _not_watertight(problem: str) -> ModelError:
    return ModelError(
        "mesh",
        problem,
        expected="a closed, outward-oriented manifold",
        action="Extract it with model.surface.extraction, or repair it first.",
    )
