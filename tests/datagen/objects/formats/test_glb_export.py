"""GLB out and in again: the same geometry, UVs and materials; equal meshes, equal bytes."""

import io
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image

from datagen.objects.formats.glb_export import corner_normals, mesh_to_glb
from datagen.objects.formats.reading import ReadingConfig, read_object
from datagen.objects.mesh.object_mesh import Material, ObjectMesh

CONFIG = ReadingConfig(unit="m", up_axis="y", max_faces=5000, max_image_px=256)


def png(color) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (4, 4), color).save(buffer, format="PNG")
    return buffer.getvalue()


@pytest.fixture
def painted_box(box) -> ObjectMesh:
    """Every field of Material in use, UVs that differ at every corner, three materials."""
    verts, faces = box
    rng = np.random.default_rng(0)
    glass = Material(
        name="glass", base_color_rgba=(0.9, 0.95, 1.0, 1.0), roughness=0.0, transmission=1.0, ior=1.5
    )
    painted = Material(
        name="painted",
        base_color_rgba=(1.0, 0.5, 0.25, 1.0),
        base_color_image=png((200, 10, 10)),
        metallic=0.25,
        roughness=0.75,
        metallic_roughness_image=png((0, 128, 255)),
        normal_image=png((128, 128, 255)),
        emissive_rgb=(2.0, 1.0, 0.0),
        emissive_image=png((255, 255, 255)),
    )
    plain = Material(name="plain", base_color_rgba=(0.1, 0.2, 0.3, 1.0))
    return ObjectMesh(
        verts_obj=verts,
        faces=faces,
        corner_uv=rng.random((12, 3, 2)),
        face_material=np.arange(12) // 4,
        materials=(painted, glass, plain),
    )


def read_back(mesh: ObjectMesh, folder, *, normals: bool = True) -> ObjectMesh:
    path = folder / "mesh.glb"
    path.write_bytes(mesh_to_glb(mesh, normals=normals))
    return read_object(path, CONFIG).mesh


@pytest.mark.parametrize("normals", [True, False])
def test_geometry_and_uvs_survive(painted_box, tmp_path, normals):
    back = read_back(painted_box, tmp_path, normals=normals)
    np.testing.assert_allclose(
        back.verts_obj[back.faces], painted_box.verts_obj[painted_box.faces], atol=1e-8
    )
    np.testing.assert_allclose(back.corner_uv, painted_box.corner_uv, atol=1e-7)
    np.testing.assert_array_equal(back.face_material, painted_box.face_material)
    assert len(back.verts_obj) == 8  # welded again across UV seams


def test_materials_survive(painted_box, tmp_path):
    for ours, theirs in zip(painted_box.materials, read_back(painted_box, tmp_path).materials, strict=True):
        assert replace(theirs, emissive_rgb=ours.emissive_rgb) == ours
        np.testing.assert_allclose(theirs.emissive_rgb, ours.emissive_rgb)


def test_equal_meshes_give_equal_bytes(painted_box):
    assert mesh_to_glb(painted_box) == mesh_to_glb(
        replace(painted_box, verts_obj=painted_box.verts_obj.copy())
    )


def test_trimesh_reads_the_file_too(painted_box):
    scene = trimesh.load_scene(io.BytesIO(mesh_to_glb(painted_box)), file_type="glb")
    np.testing.assert_allclose(scene.extents, [0.10, 0.06, 0.08], rtol=1e-6)
    assert len(scene.geometry) == 3


def test_corner_normals_are_smooth_on_a_ball_and_sharp_on_a_box(box, plain_mesh):
    ball = trimesh.creation.icosphere(3, 0.05)
    mesh = plain_mesh(ball.vertices, ball.faces)
    radial = mesh.verts_obj[mesh.faces] / 0.05
    assert (corner_normals(mesh) * radial).sum(axis=2).min() > 0.999
    flat = corner_normals(plain_mesh(*box))
    np.testing.assert_allclose(np.abs(flat).max(axis=2), 1.0)
