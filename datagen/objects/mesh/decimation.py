"""Fewer triangles for the drawn mesh; UVs, colours and materials are carried over chart by chart."""

import fast_simplification
import igl
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from datagen.objects.mesh.object_mesh import ObjectMesh

__all__ = ["decimated_mesh"]


def decimated_mesh(mesh: ObjectMesh, max_faces: int) -> ObjectMesh:
    """About `max_faces` triangles by quadric edge collapse; unchanged if there are fewer.

    Each new triangle takes the UV chart (a connected piece of the UV map, of one material) of
    the old triangle nearest to its centre; its corners take UV and colour of the nearest point of
    that chart. Colours may shift by a texel along seams.
    """
    if len(mesh.faces) <= max_faces:
        return mesh
    verts, faces = fast_simplification.simplify(
        mesh.verts_obj.astype(np.float32), mesh.faces.astype(np.int32), target_count=max_faces, agg=7
    )
    verts, faces = verts.astype(np.float64), faces.astype(np.int64)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    used, compact = np.unique(faces, return_inverse=True)
    verts, faces = verts[used], compact.reshape(-1, 3)
    chart = _charts(mesh)
    old_verts, old_faces = np.ascontiguousarray(mesh.verts_obj), np.ascontiguousarray(mesh.faces)
    _, nearest_face, _ = igl.point_mesh_squared_distance(verts[faces].mean(axis=1), old_verts, old_faces)
    nearest_face = nearest_face.astype(np.int64)
    chart_of_face = chart[nearest_face]
    old_face, barycentric = np.zeros((len(faces), 3), np.int64), np.zeros((len(faces), 3, 3))
    for index in np.unique(chart_of_face):
        chosen = chart_of_face == index
        members = np.flatnonzero(chart == index)
        found, weights = _nearest_on_faces(mesh, members, verts[faces[chosen]].reshape(-1, 3))
        old_face[chosen], barycentric[chosen] = found.reshape(-1, 3), weights.reshape(-1, 3, 3)

    def at_new_corners(rows: Float[np.ndarray, "old_face 3 column"]) -> Float[np.ndarray, "face 3 column"]:
        weights, corners = barycentric.reshape(-1, 3), rows[old_face.reshape(-1)]
        return np.einsum("pk,pkc->pc", weights, corners).reshape(len(faces), 3, -1)

    return mesh.with_corners(
        at_new_corners,
        verts_obj=verts,
        faces=faces,
        face_material=mesh.face_material[nearest_face],
    )


def _charts(mesh: ObjectMesh) -> Int[np.ndarray, " face"]:
    """Number of the UV chart of every face: same material, connected through equal UVs."""
    corners = np.concatenate(
        [
            mesh.faces.reshape(-1, 1),
            np.repeat(mesh.face_material, 3)[:, None],
            np.round(mesh.corner_uv.reshape(-1, 2) * 2**16).astype(np.int64),
        ],
        axis=1,
    )
    _, node = np.unique(corners, axis=0, return_inverse=True)
    node = node.reshape(-1, 3)
    n_nodes = int(node.max()) + 1
    rows = np.concatenate([node[:, 0], node[:, 0]])
    columns = np.concatenate([node[:, 1], node[:, 2]])
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(n_nodes, n_nodes))
    return connected_components(graph, directed=False)[1][node[:, 0]].astype(np.int64)


def _nearest_on_faces(
    mesh: ObjectMesh, members: Int[np.ndarray, " member"], points: Float[np.ndarray, "point 3"]
) -> tuple[Int[np.ndarray, " point"], Float[np.ndarray, "point 3"]]:
    """The nearest point among some faces of the mesh: its face and barycentric coordinates."""
    old_verts = np.ascontiguousarray(mesh.verts_obj)
    member_faces = np.ascontiguousarray(mesh.faces[members])
    _, face, nearest = igl.point_mesh_squared_distance(points, old_verts, member_faces)
    triangle = old_verts[member_faces[face]]
    barycentric = igl.barycentric_coordinates(
        nearest, *(np.ascontiguousarray(triangle[:, k]) for k in range(3))
    )
    return members[face], np.clip(barycentric, 0.0, 1.0)
