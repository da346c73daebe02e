"""Fewer triangles and fewer crumbs, still manifold."""

import numpy as np
from scipy.spatial import KDTree

from model.surface.mesh import SurfaceMesh, as_manifold, face_components, face_volumes

__all__ = ["simplify", "without_small_components"]

_ATTEMPTS = 8
_GOOD_ENOUGH = 0.85  # of the wanted number of faces


def without_small_components(mesh: SurfaceMesh, min_volume_share: float) -> tuple[SurfaceMesh, int]:
    """Drops closed pieces (cavities are pieces too) below this share of the largest one's volume; and how many."""
    component = face_components(mesh.faces)
    volume = np.abs(np.bincount(component, face_volumes(mesh)))
    kept = volume >= min_volume_share * volume.max()
    faces = mesh.faces[kept[component]]
    used, compact = np.unique(faces, return_inverse=True)
    smaller = SurfaceMesh(
        vertices=mesh.vertices[used],
        faces=compact.reshape(-1, 3).astype(np.int32),
        colors=mesh.colors[used],
    )
    return smaller, int(np.count_nonzero(~kept))


def simplify(mesh: SurfaceMesh, max_faces: int, max_move: float) -> SurfaceMesh:
    """Manifold's edge collapses, which keep it manifold: `max_faces` triangles, or as near as `max_move` allows.

    The surface moves by at most `max_move` (unit of the vertices); how far is found by bisection, which ends within
    15 % below `max_faces`. Vertices keep their places and colours, so colours need vertices: few faces blur them.
    ModelError: not a manifold.
    """
    watertight = as_manifold(mesh)
    if len(mesh.faces) <= max_faces:
        return mesh
    found = watertight
    low, high = np.log(1e-3 * max_move), np.log(max_move)
    at = high
    for _ in range(_ATTEMPTS):
        coarser = watertight.simplify(float(np.exp(at)))
        if _nearer(coarser.num_tri(), found.num_tri(), max_faces):
            found = coarser
        if _GOOD_ENOUGH * max_faces <= found.num_tri() <= max_faces:
            break
        if coarser.num_tri() > max_faces:
            low = at
        else:
            high = at
        if low >= high:  # not even max_move is enough
            break
        at = 0.5 * (low + high)
    arrays = found.to_mesh()
    vertices = arrays.vert_properties[:, :3].astype(np.float32)
    # Collapses leave one end of an edge where it was, so every vertex is one of the old ones.
    old = KDTree(mesh.vertices).query(vertices)[1]
    return SurfaceMesh(vertices=vertices, faces=arrays.tri_verts.astype(np.int32), colors=mesh.colors[old])


def _nearer(faces: int, than: int, wanted: int) -> bool:
    """Whether a mesh of `faces` faces is the better one; one that vanished is never."""
    if faces == 0:
        return False
    return wanted >= faces > than or (faces < than and than > wanted)
