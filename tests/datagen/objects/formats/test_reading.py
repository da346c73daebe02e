"""Every format into one frame, and one clear line for every bad file."""

import io
import json
import struct

import numpy as np
import pytest
import trimesh
from PIL import Image

from datagen.objects.errors import ObjectError
from datagen.objects.formats.glb_export import mesh_to_glb
from datagen.objects.formats.reading import ReadingConfig, read_object
from datagen.objects.mesh.surface_points import sample_surface

CONFIG = ReadingConfig(unit="auto", up_axis="y", max_faces=5000, max_image_px=256)

QUAD = "v 0 0 0\nv 4 0 0\nv 4 2 0\nv 0 2 0\nv 0 0 10\n"


def png(color=(200, 30, 30), size=(8, 8)) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", size, color).save(buffer, format="PNG")
    return buffer.getvalue()


def glb(document: dict, binary: bytes = b"") -> bytes:
    text = json.dumps({"asset": {"version": "2.0"}, **document}).encode()
    text += b" " * (-len(text) % 4)
    chunks = (
        struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def test_y_up_centimetres_become_z_up_metres_about_the_centre(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text(QUAD + "f 1 2 3 4\nf 1 2 5\n")
    read = read_object(path, CONFIG)
    assert read.unit == "cm"
    np.testing.assert_allclose(np.ptp(read.mesh.verts_obj, axis=0), [0.04, 0.10, 0.02])
    np.testing.assert_allclose(read.mesh.verts_obj.max(axis=0), -read.mesh.verts_obj.min(axis=0))
    corner_file = np.array([4.0, 2.0, 0.0, 1.0])  # up is +y there, so +z here
    corner_obj = (read.T_obj_from_file @ corner_file)[:3]
    np.testing.assert_allclose(corner_obj, [0.02, 0.05, 0.01])
    assert np.linalg.norm(read.mesh.verts_obj - corner_obj, axis=1).min() < 1e-12


def test_concave_polygon_keeps_its_area(tmp_path):
    path = tmp_path / "l.obj"  # an L of area 3
    path.write_text("v 0 0 0\nv 2 0 0\nv 2 1 0\nv 1 1 0\nv 1 2 0\nv 0 2 0\nv 0 0 1\nf 4 5 6 1 2 3\nf 1 2 7\n")
    mesh = read_object(path, ReadingConfig(unit="m", up_axis="z", max_faces=99, max_image_px=256)).mesh
    flat = np.ptp(mesh.verts_obj[mesh.faces][..., 2], axis=1) == 0
    corners = mesh.verts_obj[mesh.faces[flat]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    np.testing.assert_allclose(normals.sum(axis=0) / 2, [0, 0, 3])
    assert (normals[:, 2] > 0).all()


def test_mtl_becomes_plausible_materials(tmp_path):
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\n" + QUAD + "vt 0 0\nvt 1 0\nvt 1 1\nusemtl pane glass\nf 1 2 3\n"
        "usemtl chrome\nf 1 3 4\nusemtl cloth\nf 1/1 2/2 5/3\n"
    )
    (tmp_path / "a.mtl").write_text(
        "newmtl pane glass\nKd .5 .5 .5\nd 0.25\nnewmtl chrome\nKd .7 .7 .7\nKs .9 .9 .9\nNs 120\n"
        "newmtl cloth\nKd 0 0 0\nKs 0 0 0\nNs 96\nmap_Kd -s 1 1 1 red.png\n"
    )
    (tmp_path / "red.png").write_bytes(png())
    glass, chrome, cloth = read_object(tmp_path / "a.obj", CONFIG).mesh.materials
    assert glass.transmission == 1
    assert glass.roughness < 0.1
    assert chrome.metallic == 1
    assert cloth.base_color_image == png()
    assert cloth.base_color_rgba == (1.0, 1.0, 1.0, 1.0)
    assert cloth.roughness > 0.6


@pytest.mark.parametrize("suffix", ["ply", "stl", "glb", "obj"])
def test_formats_agree(tmp_path, suffix):
    box = trimesh.creation.box((0.10, 0.08, 0.06))
    box.export(tmp_path / f"box.{suffix}")
    config = ReadingConfig(unit="m", up_axis="y", max_faces=5000, max_image_px=256)
    mesh = read_object(tmp_path / f"box.{suffix}", config).mesh
    np.testing.assert_allclose(np.ptp(mesh.verts_obj, axis=0), [0.10, 0.06, 0.08], rtol=1e-6)
    assert len(mesh.verts_obj) == 8
    assert len(mesh.faces) == 12
    assert trimesh.Trimesh(mesh.verts_obj, mesh.faces).volume == pytest.approx(480e-6, rel=1e-5)


def test_vertex_colours_are_the_colour_of_the_surface(tmp_path):
    ball = trimesh.creation.icosphere(2, 0.05)
    ball.visual.vertex_colors = np.where(ball.vertices[:, 2:] > 0, [[255, 0, 0, 255]], [[0, 0, 255, 255]])
    ball.export(tmp_path / "ball.ply")
    config = ReadingConfig(unit="m", up_axis="z", max_faces=5000, max_image_px=2048)
    mesh = read_object(tmp_path / "ball.ply", config).mesh
    samples = sample_surface(mesh, 500, np.random.default_rng(0))
    top, bottom = samples.points_obj[:, 2] > 0.02, samples.points_obj[:, 2] < -0.02
    np.testing.assert_allclose(samples.colors[top], [[1, 0, 0]] * top.sum(), atol=0.02)
    np.testing.assert_allclose(samples.colors[bottom], [[0, 0, 1]] * bottom.sum(), atol=0.02)


def test_scene_transforms_are_applied(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((0.02, 0.02, 0.02)))
    moved = trimesh.transformations.translation_matrix([0.1, 0, 0])
    scene.add_geometry(trimesh.creation.box((0.02, 0.02, 0.02)), transform=moved)
    scene.export(tmp_path / "two.glb")
    mesh = read_object(tmp_path / "two.glb", CONFIG).mesh
    assert len(mesh.faces) == 24
    np.testing.assert_allclose(np.ptp(mesh.verts_obj, axis=0), [0.12, 0.02, 0.02], rtol=1e-5)


def write(name: str, data: bytes | str):
    def into(folder):
        path = folder / name
        path.write_bytes(data if isinstance(data, bytes) else data.encode())
        return path

    return into


def with_image(image: bytes):
    def into(folder):
        (folder / "a.mtl").write_text("newmtl m\nmap_Kd a.png\n")
        (folder / "a.png").write_bytes(image)
        return write("a.obj", "mtllib a.mtl\n" + QUAD + "usemtl m\nf 1 2 3\nf 1 2 5\n")(folder)

    return into


TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype="<f4").tobytes()
MESH = {
    "scenes": [{"nodes": [0]}],
    "nodes": [{"mesh": 0}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
    "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
    "bufferViews": [{"buffer": 0, "byteLength": 36}],
    "buffers": [{"byteLength": 36}],
}

BAD = {
    "absent": (lambda folder: folder / "none.glb", "does not exist"),
    "empty": (write("a.glb", b""), "is empty"),
    "other format": (write("a.txt", "hello"), "not a mesh format"),
    "not a mesh (glb)": (write("a.glb", b"\x89PNG not a mesh at all"), "is not glTF"),
    "not a mesh (ply)": (write("a.ply", b"hello"), "is not a PLY file"),
    "not a mesh (stl)": (write("a.stl", b"hello"), "holds no triangles"),
    "not a mesh (obj)": (write("a.obj", "hello\nworld\n"), "has no faces"),
    "points only": (write("a.obj", QUAD), r"has no faces \(5 vertices\)"),
    "bad number": (write("a.obj", "v 0 zero 0\n"), "line 1 cannot be read"),
    "index beyond": (write("a.obj", QUAD + "f 1 2 9\n"), "line 6 cannot be read.*index 9 of 5"),
    "NaN": (write("a.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"), "1 of 3 vertices are NaN"),
    "infinite": (write("a.obj", "v inf 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"), "NaN or infinite"),
    "zero size": (write("a.obj", "v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n"), "has no extent"),
    "zero area": (write("a.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"), "has no extent"),
    "too many faces": (write("a.obj", QUAD + "f 1 2 3\n" * 6000), "has 6,000 triangles"),
    "missing texture": (
        lambda folder: [with_image(png())(folder), (folder / "a.png").unlink()][0],
        "texture 'a.png' is missing",
    ),
    "missing mtl": (
        write("a.obj", "mtllib b.mtl\nusemtl x\n" + QUAD + "f 1 2 3\n"),
        "library 'b.mtl' is missing",
    ),
    "unknown material": (
        lambda folder: write("a.obj", "mtllib a.mtl\n" + QUAD + "usemtl x\nf 1 2 3\n")(
            write("a.mtl", "newmtl y\n")(folder).parent
        ),
        "material 'x' is in none",
    ),
    "broken image": (with_image(png()[:40]), "cannot be decoded"),
    "huge image": (with_image(png(size=(300, 8))), "is 300x8"),
    "skinned": (
        write("a.glb", glb({**MESH, "nodes": [{"mesh": 0, "skin": 0}]}, TRIANGLE)),
        "is skinned",
    ),
    "unknown extension": (
        write("a.glb", glb({**MESH, "extensionsRequired": ["EXT_of_tomorrow"]}, TRIANGLE)),
        "requires EXT_of_tomorrow",
    ),
    "cut short": (write("a.glb", glb(MESH, TRIANGLE)[:-20]), "is cut short"),
    "buffer too small": (write("a.glb", glb(MESH, TRIANGLE[:20])), "reaches beyond"),
    "dangling reference": (write("a.glb", glb({**MESH, "accessors": []}, TRIANGLE)), "not there"),
    "old glTF": (write("a.gltf", '{"asset": {"version": "1.0"}}'), "is glTF 1.0"),
    "missing buffer": (
        write("a.gltf", '{"asset": {"version": "2.0"}, "buffers": [{"uri": "b.bin", "byteLength": 4}]}'),
        "buffer 'b.bin' is missing",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_get_one_clear_line(case, tmp_path):
    make, message = BAD[case]
    path = make(tmp_path)
    with pytest.raises(ObjectError, match=message) as caught:
        read_object(path, CONFIG)
    text = str(caught.value)
    assert text.startswith(str(tmp_path))
    assert "expected" in text
    assert "\n" not in text


def test_triangle_of_a_hand_made_glb_is_read(tmp_path):
    path = write("a.glb", glb(MESH, TRIANGLE))(tmp_path)
    np.testing.assert_allclose(np.ptp(read_object(path, CONFIG).mesh.verts_obj, axis=0), [1, 0, 1])


def test_export_is_used_by_the_reader(tmp_path, box, plain_mesh):
    path = tmp_path / "a.glb"
    path.write_bytes(mesh_to_glb(plain_mesh(*box)))
    np.testing.assert_allclose(
        np.ptp(read_object(path, CONFIG).mesh.verts_obj, axis=0), [0.10, 0.08, 0.06], rtol=1e-6
    )
