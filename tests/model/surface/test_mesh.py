"""Each fault of a mesh is found and named; a sound one is measured."""

import numpy as np
import pytest
import trimesh

from model.errors import ModelError
from model.surface.cube_cases import edge_loops, triangle_table
from model.surface.mesh import SurfaceMesh, check_manifold, face_volumes, vertex_normals


def _mesh(vertices, faces) -> SurfaceMesh:
    return SurfaceMesh(
        vertices=np.asarray(vertices, dtype=np.float32),
        faces=np.asarray(faces, dtype=np.int32),
        colors=np.zeros((len(vertices), 3), dtype=np.float32),
    )


def _box(low=(0.0, 0.0, 0.0)) -> SurfaceMesh:
    box = trimesh.creation.box(bounds=[low, np.array(low) + 1.0])
    return _mesh(box.vertices, box.faces)


def _joined(a: SurfaceMesh, b: SurfaceMesh) -> SurfaceMesh:
    vertices = np.concatenate([a.vertices, b.vertices])
    unique, inverse = np.unique(vertices, axis=0, return_inverse=True)
    return _mesh(unique, inverse.reshape(-1)[np.concatenate([a.faces, b.faces + len(a.vertices)])])


def test_a_sound_mesh_is_measured() -> None:
    report = check_manifold(_box())
    assert (report.vertices, report.faces, report.components, report.genus) == (8, 12, 1, 0)
    assert report.volume == pytest.approx(1.0)
    assert report.area == pytest.approx(6.0)
    ring = trimesh.creation.torus(1.0, 0.3)
    assert check_manifold(_mesh(ring.vertices, ring.faces)).genus == 1


def test_faults_are_named() -> None:
    box = _box()
    flipped = box.faces.copy()
    flipped[3] = flipped[3, ::-1]
    nan = box.vertices.copy()
    nan[2] = np.nan
    for mesh, message in (
        (_mesh(box.vertices, box.faces[:0]), "it has no face"),
        (_mesh(box.vertices, box.faces[1:]), "3 edges have one face and 0 more than two"),
        (_mesh(box.vertices, flipped), "the two faces of 3 edges are turned against each other"),
        (_mesh(box.vertices, box.faces[:, ::-1]), "it is inside out"),
        (_mesh(nan, box.faces), "1 vertices are not finite"),
        (_mesh(np.concatenate([box.vertices, [[9, 9, 9]]]), box.faces), "1 vertices belong to no face"),
        (_mesh(box.vertices[:6], box.faces), "faces name vertices 0..7 of 6"),
        (_mesh(box.vertices, np.concatenate([box.faces, [[0, 0, 1]]])), "1 faces use a vertex twice"),
        (_joined(box, _box((1.0, 1.0, 0.0))), "0 edges have one face and 1 more than two"),
        (_joined(box, _box((1.0, 1.0, 1.0))), "1 vertices join sheets that touch in a point only"),
    ):
        with pytest.raises(ModelError, match=message):
            check_manifold(mesh)


def test_normals_point_outward() -> None:
    ball = trimesh.creation.icosphere(3)
    mesh = _mesh(ball.vertices, ball.faces)
    assert (vertex_normals(mesh) * mesh.vertices).sum(1).min() > 0.999
    assert face_volumes(mesh).sum() == pytest.approx(ball.volume, rel=1e-5)


def test_cube_cases() -> None:
    """Every crossed edge is in one loop; opposite patterns cross the same edges; at most five triangles."""
    table = triangle_table()
    assert table[[0, 255]].max() == -1
    for case in range(256):
        crossed = sorted(edge for loop in edge_loops(case) for edge in loop)
        used = table[case][table[case] >= 0]
        assert crossed == sorted(set(used.tolist()))
        assert crossed == sorted(edge for loop in edge_loops(255 - case) for edge in loop)
        assert len(used) == 3 * sum(len(loop) - 2 for loop in edge_loops(case))
