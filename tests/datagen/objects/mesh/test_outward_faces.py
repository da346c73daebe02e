"""Faces outward, once each."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from datagen.objects.mesh.decimation import decimated_mesh
from datagen.objects.mesh.object_mesh import Material, ObjectMesh
from datagen.objects.mesh.outward_faces import outward_mesh
from datagen.objects.mesh.submeshes import mesh_pieces, sub_mesh
from datagen.objects.mesh.surface_points import face_areas, face_normals


def signed_volume(mesh) -> float:
    return float(trimesh.Trimesh(mesh.verts_obj, mesh.faces, process=False).volume)


@pytest.mark.parametrize("turned", ["all", "some", "none"])
def test_box_faces_outward_whatever_the_file_says(box, plain_mesh, turned):
    verts, faces = box
    faces = faces.copy()
    chosen = {"all": slice(None), "some": slice(2, 7), "none": slice(0, 0)}[turned]
    faces[chosen] = faces[chosen, ::-1]
    assert signed_volume(outward_mesh(plain_mesh(verts, faces))) == pytest.approx(480e-6)


def test_uvs_move_with_their_corners(box, plain_mesh):
    mesh = plain_mesh(box[0], box[1][:, ::-1])
    mesh = replace(mesh, corner_uv=mesh.verts_obj[mesh.faces][..., :2])
    turned = outward_mesh(mesh)
    np.testing.assert_array_equal(turned.corner_uv, turned.verts_obj[turned.faces][..., :2])


def test_open_cup_faces_outward(sheet_cup, plain_mesh):
    mesh = outward_mesh(plain_mesh(sheet_cup[0], sheet_cup[1][:, ::-1]))
    normals = face_normals(mesh.verts_obj, mesh.faces)
    centers = mesh.verts_obj[mesh.faces].mean(axis=1)
    wall = np.abs(normals[:, 2]) < 0.5
    assert ((normals * centers)[wall, :2].sum(axis=1) > 0).all()


def test_repeated_triangles_are_dropped(box, plain_mesh):
    verts, faces = box
    doubled = np.concatenate([faces, faces[:5, ::-1], faces[3:4]])
    assert len(outward_mesh(plain_mesh(verts, doubled)).faces) == 12


def test_pieces_of_a_pair(box, plain_mesh):
    verts, faces = box
    pair = plain_mesh(
        np.concatenate([verts + np.array([0.2, 0, 0]), verts]), np.concatenate([faces, faces + 8])
    )
    piece = mesh_pieces(pair)
    assert sorted(np.unique(piece)) == [0, 1]
    left = sub_mesh(pair, piece == 0)
    assert len(left.faces) == 12
    np.testing.assert_allclose(left.verts_obj.max(axis=0), [0.05, 0.04, 0.03])
    assert (piece[12:] == 0).all()  # the second box lies to the left


def test_decimation_carries_materials_and_uvs():
    ball = trimesh.creation.icosphere(4, 0.05)
    verts, faces = np.array(ball.vertices), np.array(ball.faces)
    mesh = ObjectMesh(
        verts_obj=verts,
        faces=faces,
        corner_uv=verts[faces][..., :2] * 10,
        face_material=(verts[faces].mean(axis=1)[:, 2] > 0).astype(np.int64),
        materials=tuple(Material(name=n, base_color_rgba=(1.0, 1.0, 1.0, 1.0)) for n in ("low", "high")),
    )
    light = decimated_mesh(mesh, 800)
    assert len(light.faces) <= 800
    assert face_areas(light.verts_obj, light.faces).sum() == pytest.approx(ball.area, rel=0.02)
    centers = light.verts_obj[light.faces].mean(axis=1)
    clear = np.abs(centers[:, 2]) > 0.008
    np.testing.assert_array_equal(light.face_material[clear], (centers[clear, 2] > 0).astype(int))
    error = np.abs(light.corner_uv - light.verts_obj[light.faces][..., :2] * 10)
    assert np.median(error) < 0.005
