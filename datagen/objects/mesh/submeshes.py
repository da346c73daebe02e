"""Taking a drawn mesh apart."""

import igl
import numpy as np
from jaxtyping import Bool, Int

from datagen.objects.mesh.object_mesh import ObjectMesh

__all__ = ["mesh_pieces", "sub_mesh"]


def sub_mesh(mesh: ObjectMesh, kept: Bool[np.ndarray, " face"]) -> ObjectMesh:
    """The chosen faces alone; the frame's origin moves to their bbox centre."""
    used, compact = np.unique(mesh.faces[kept], return_inverse=True)
    verts = mesh.verts_obj[used]
    return mesh.with_corners(
        lambda rows: rows[kept],
        verts_obj=verts - 0.5 * (verts.min(axis=0) + verts.max(axis=0)),
        faces=compact.reshape(-1, 3),
        face_material=mesh.face_material[kept],
    )


def mesh_pieces(mesh: ObjectMesh) -> Int[np.ndarray, " face"]:
    """Which separate thing each face belongs to, numbered along x.

    Connected parts whose boxes overlap are one thing (sole and strap of a slipper).
    """
    n_parts, part = igl.facet_components(np.ascontiguousarray(mesh.faces))
    part = part.astype(np.int64)
    low = np.array([mesh.verts_obj[mesh.faces[part == k]].min(axis=(0, 1)) for k in range(n_parts)])
    high = np.array([mesh.verts_obj[mesh.faces[part == k]].max(axis=(0, 1)) for k in range(n_parts)])
    group = np.arange(n_parts)
    for a in range(n_parts):
        overlapping = ((low[a] <= high) & (low <= high[a])).all(axis=1)
        joined = np.unique(group[overlapping])
        group[np.isin(group, joined)] = joined.min()
    names = np.unique(group)
    left = np.array([low[group == name, 0].min() for name in names])
    rank = np.empty(len(names), dtype=np.int64)
    rank[np.argsort(left, kind="stable")] = np.arange(len(names))
    return rank[np.searchsorted(names, group)][part]
