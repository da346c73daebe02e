"""PLY of many writers: layouts, types, colours, textures, and what is no mesh."""

import io
import struct
from functools import partial

import numpy as np
import pytest
from PIL import Image

from datagen.objects.errors import ObjectError
from datagen.objects.formats.ply import read_ply
from datagen.objects.formats.reading import ReadingConfig, read_object
from datagen.objects.mesh.surface_points import sample_surface
from shards.color import linear_from_srgb
from tests.datagen.objects.formats.damage import refusals

CONFIG = ReadingConfig(unit="m", up_axis="z", max_faces=5000, max_image_px=256)
CODES = {
    "char": "b",
    "uchar": "B",
    "short": "h",
    "ushort": "H",
    "int": "i",
    "uint": "I",
    "float": "f",
    "double": "d",
}
CODES |= {"uint8": "B", "int32": "i", "uint32": "I", "float32": "f", "float64": "d"}

VERTS = [(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.1)]
TETRA = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)]
XYZ = [("float", "x"), ("float", "y"), ("float", "z")]
INDICES = [(("uchar", "int"), "vertex_indices")]


def ply(elements, form="ascii", *, comments=(), newline=b"\n") -> bytes:
    """A file of (name, properties, rows); the type of a list is (type of its length, type of its numbers)."""
    lines = [b"ply", f"format {form} 1.0".encode(), *comments]
    body = bytearray()
    order = ">" if "big" in form else "<"
    for name, properties, rows in elements:
        lines.append(f"element {name} {len(rows)}".encode())
        for kind, label in properties:
            spelled = f"list {kind[0]} {kind[1]}" if isinstance(kind, tuple) else kind
            lines.append(f"property {spelled} {label}".encode())
        for row in rows:
            words = []
            for (kind, _), value in zip(properties, row, strict=True):
                if isinstance(kind, tuple):
                    words += [(kind[0], len(value)), *((kind[1], number) for number in value)]
                else:
                    words.append((kind, value))
            if form == "ascii":
                body += (
                    " ".join(
                        (f"{number:.9g}" if isinstance(number, float) else str(number)) for _, number in words
                    ).encode()
                    + newline
                )
            else:
                body += b"".join(struct.pack(order + CODES[kind], number) for kind, number in words)
    return newline.join([*lines, b"end_header", b""]) + bytes(body)


def mesh_of(verts=VERTS, faces=TETRA, extra=(), values=None, face_extra=(), face_values=None):
    rows = [(*vert, *(values[k] if values else ())) for k, vert in enumerate(verts)]
    face_rows = [(face, *(face_values[k] if face_values else ())) for k, face in enumerate(faces)]
    return [("vertex", [*XYZ, *extra], rows), ("face", [*INDICES, *face_extra], face_rows)]


def read(tmp_path, data: bytes):
    (tmp_path / "a.ply").write_bytes(data)
    return read_ply(tmp_path / "a.ply", data, max_file_mb=1.0)


def png(pixels) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.array(pixels, dtype=np.uint8)).save(buffer, format="PNG")
    return buffer.getvalue()


FORMS = ("ascii", "binary_little_endian", "binary_big_endian")


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("newline", [b"\n", b"\r\n", b"\r"])
def test_every_encoding_and_line_end(tmp_path, form, newline):
    # In the binary files the first byte behind a CR header is a line feed: 10 as a double's lowest byte.
    verts = [(struct.unpack("<f", b"\n\0\0\0")[0], 0, 0), *VERTS[1:]]
    found = read(tmp_path, ply(mesh_of(verts), form, newline=newline))
    np.testing.assert_allclose(found.verts_file, VERTS, atol=1e-8)
    np.testing.assert_array_equal(found.faces, TETRA)
    assert found.corner_colors is None
    assert found.materials[0].base_color_rgba == (0.6, 0.6, 0.6, 1.0)
    assert found.notes == ()


@pytest.mark.parametrize("form", FORMS)
def test_triangles_quads_and_concave_polygons_mixed(tmp_path, form):
    verts = [(0, 0, 0), (2, 0, 0), (2, 1, 0), (1, 1, 0), (1, 2, 0), (0, 2, 0), (0, 0, 1)]
    faces = [(3, 4, 5, 0, 1, 2), (0, 1, 6), (1, 2, 3, 0), (0, 1)]  # areas 3, 1 (in y), 1.5, nothing
    found = read(tmp_path, ply(mesh_of(verts, faces), form))
    a, b, c = (found.verts_file[found.faces[:, k]] for k in range(3))
    normals = 0.5 * np.cross(b - a, c - a)
    assert len(found.faces) == 4 + 1 + 2
    np.testing.assert_allclose(normals.sum(axis=0), [0, -1, 4.5])
    assert (normals[np.abs(normals[:, 1]) == 0, 2] > 0).all()


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("ragged", [False, True])
def test_unknown_properties_and_elements_around_the_known_ones(tmp_path, form, ragged):
    faces = [*TETRA, (0, 2, 1, 3)] if ragged else TETRA
    curvature = [[0.5] * (k % 3 if ragged else 2) for k in range(len(faces))]
    elements = [
        ("camera", [("float", "view_px")], [(1.5,)]),
        ("face", [("short", "flags"), (("ushort", "double"), "curvature"), (("int", "uint"), "vertex_index"),
                  ("uchar", "quality")],
         [(7, values, face, 9) for values, face in zip(curvature, faces)]),
        ("material", [(("uchar", "uchar"), "letters")], [([104, 105],), ([],)]),
        ("vertex", [("double", "confidence"), *XYZ, (("uchar", "float"), "weights")],
         [(0.5, *vert, [1.0] * (k if ragged else 1)) for k, vert in enumerate(VERTS)]),
        ("tail", [("int", "n")], []),
    ]  # fmt: skip
    found = read(tmp_path, ply(elements, form, comments=[b"obj_info by hand", b"comment", b""]))
    np.testing.assert_allclose(found.verts_file, np.array(VERTS), rtol=1e-6)
    np.testing.assert_array_equal(found.faces[:4], TETRA)
    assert len(found.faces) == (6 if ragged else 4)
    assert found.notes == ("the PLY element 'material' is not read",)


def test_type_names_of_either_kind(tmp_path):
    elements = [
        ("vertex", [("float64", "x"), ("float32", "y"), ("double", "z")], VERTS),
        ("face", [(("uint8", "int32"), "vertex_indices")], [(face,) for face in TETRA]),
    ]
    found = read(tmp_path, ply(elements, "binary_little_endian"))
    np.testing.assert_array_equal(found.faces, TETRA)


def test_header_with_latin_1_byte_order_mark_and_capitals(tmp_path):
    data = ply(mesh_of(), comments=["comment C:\\Users\\Jürgen".encode("latin-1")])
    found = read(
        tmp_path, b"\xef\xbb\xbf" + data.replace(b"ply", b"PLY", 1).replace(b"end_header", b"END_HEADER ")
    )
    np.testing.assert_array_equal(found.faces, TETRA)


GREY = {"uchar": 128, "uint8": 128, "float": 128 / 255, "double": 128 / 255, "ushort": 128 * 257, "int": 128}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", GREY)
@pytest.mark.parametrize("names", ["red green blue", "r g b", "diffuse_red diffuse_green diffuse_blue"])
@pytest.mark.parametrize("where", ["vertex", "face"])
def test_colours_of_every_type_and_name(tmp_path, form, kind, names, where):
    full = {"float": 1.0, "double": 1.0, "ushort": 65535}.get(kind, 255)
    colors = [(GREY[kind], 0, full)] * 4
    extra = [(kind, name) for name in names.split()]
    elements = (
        mesh_of(extra=extra, values=colors)
        if where == "vertex"
        else mesh_of(face_extra=extra, face_values=colors)
    )
    found = read(tmp_path, ply(elements, form))
    grey = linear_from_srgb(np.array(128 / 255))
    np.testing.assert_allclose(found.corner_colors, np.broadcast_to([grey, 0, 1], (4, 3, 3)), rtol=1e-6)
    assert found.materials[0].base_color_rgba == (1.0, 1.0, 1.0, 1.0)
    assert found.notes == ()


@pytest.mark.parametrize(
    ("kind", "written", "shown", "note"),
    [
        ("float", (128, 0, 255), (128 / 255, 0, 1), "float32 reach 255: 255 was taken for full, not 1"),
        ("float", (0.5, 0, 1.0001), (0.5, 0, 1), None),
        ("ushort", (128, 0, 255), (128 / 255, 0, 1), "uint16 reach 255: 255 was taken for full, not 65535"),
        ("int", (65535, 0, 257), (1, 0, 1 / 255), "int32 reach 65535: 65535 was taken for full, not 255"),
        ("char", (-128, 0, -1), (128 / 255, 0, 1), None),
    ],
)
def test_colours_whose_range_contradicts_their_type(tmp_path, kind, written, shown, note):
    extra = [(kind, "red"), (kind, "green"), (kind, "blue")]
    found = read(tmp_path, ply(mesh_of(extra=extra, values=[written] * 4), "binary_little_endian"))
    np.testing.assert_allclose(found.corner_colors[0, 0], linear_from_srgb(np.array(shown)), rtol=1e-6)
    assert len(found.notes) == (note is not None)
    assert note is None or note in found.notes[0]


@pytest.mark.parametrize(("alpha", "noted"), [(255, False), (100, True), (0, False)])
def test_alpha_is_not_drawn_and_that_is_said(tmp_path, alpha, noted):
    extra = [("uchar", name) for name in ("red", "green", "blue", "alpha")]
    found = read(tmp_path, ply(mesh_of(extra=extra, values=[(255, 0, 0, alpha)] * 4)))
    np.testing.assert_array_equal(found.corner_colors[..., 0], 1)
    assert found.notes == (("vertex colours are partly transparent; drawn opaque",) if noted else ())


def test_of_colours_of_vertices_and_faces_those_are_drawn_that_vary(tmp_path):
    rgb = [("uchar", "red"), ("uchar", "green"), ("uchar", "blue")]
    white, by_face = [(255, 255, 255)] * 4, [(255, 0, 0), (0, 255, 0), (0, 0, 255), (0, 0, 0)]
    both = read(tmp_path, ply(mesh_of(extra=rgb, values=white, face_extra=rgb, face_values=by_face)))
    np.testing.assert_array_equal(both.corner_colors[:, 0] * 255, by_face)
    assert "those of the faces are drawn" in both.notes[0]
    other = read(tmp_path, ply(mesh_of(extra=rgb, values=by_face, face_extra=rgb, face_values=white)))
    np.testing.assert_array_equal(other.corner_colors[0] * 255, [by_face[k] for k in TETRA[0]])


def test_drawn_colour_is_the_written_one(tmp_path):
    rgb = [("uchar", "red"), ("uchar", "green"), ("uchar", "blue")]
    (tmp_path / "a.ply").write_bytes(ply(mesh_of(extra=rgb, values=[(200, 100, 50)] * 4)))
    colors = sample_surface(read_object(tmp_path / "a.ply", CONFIG).mesh, 50, np.random.default_rng(0)).colors
    np.testing.assert_allclose(colors * 255, [[200, 100, 50]] * 50, atol=1)


SQUARE = [(0, 0, 0), (0.1, 0, 0), (0.1, 0.1, 0), (0, 0.1, 0)]
UV = [(0, 0), (1, 0), (1, 1), (0, 1)]
HALVES = [[(255, 0, 0)] * 4] * 2 + [[(0, 0, 255)] * 4] * 2  # red above blue
TEXTURED = [b"comment TextureFile tex.png"]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("names", ["texture_u texture_v", "u v", "s t", "wedges"])
def test_texture_of_a_comment_is_drawn_upright(tmp_path, form, names):
    (tmp_path / "tex.png").write_bytes(png(HALVES))
    if names == "wedges":
        flat = [number for pair in UV for number in pair]
        elements = mesh_of(
            SQUARE, [(0, 1, 2, 3)], face_extra=[(("uchar", "float"), "texcoord")], face_values=[(flat,)]
        )
    else:
        elements = mesh_of(
            SQUARE, [(0, 1, 2, 3)], extra=[("float", name) for name in names.split()], values=UV
        )
    (tmp_path / "a.ply").write_bytes(ply(elements, form, comments=TEXTURED))
    read = read_object(tmp_path / "a.ply", CONFIG)
    assert read.mesh.materials[0].base_color_image == png(HALVES)
    samples = sample_surface(read.mesh, 300, np.random.default_rng(0))
    height = samples.points_obj[:, 1]
    clear = (np.abs(height) > 0.02) & (np.abs(height) < 0.035)  # of both borders: textures repeat
    above, below = clear & (height > 0), clear & (height < 0)
    np.testing.assert_allclose(samples.colors[above], [[1, 0, 0]] * above.sum(), atol=0.02)
    np.testing.assert_allclose(samples.colors[below], [[0, 0, 1]] * below.sum(), atol=0.02)
    assert read.notes == ()


def test_several_textures_by_number_and_faces_without_one(tmp_path):
    for name in ("one.png", "two.png"):
        (tmp_path / name).write_bytes(png([[(1, 2, 3)]]))
    uv = [0, 0, 1, 0, 1, 1]
    extra = [(("uchar", "float"), "texcoord"), ("int", "texnumber")]
    values = [(uv, 0), (uv, 1), ([], 0), (uv, -1)]
    comments = [b"comment TextureFile one.png", b"comment texture_file: two.png"]
    for form in FORMS:
        found = read(tmp_path, ply(mesh_of(face_extra=extra, face_values=values), form, comments=comments))
        np.testing.assert_array_equal(found.face_material, [0, 1, 2, 2])
        assert [material.name for material in found.materials] == ["one.png", "two.png", "plain"]
        np.testing.assert_array_equal(found.corner_uv[:2].reshape(2, 6), [uv, uv])


def textured(**more):
    return mesh_of(
        extra=[("float", "s"), ("float", "t"), *more.get("extra", ())], values=more.get("values", UV)
    )


def test_texture_and_colours_are_not_multiplied(tmp_path):
    (tmp_path / "tex.png").write_bytes(png(HALVES))
    rgb = [("uchar", "red"), ("uchar", "green"), ("uchar", "blue")]
    for color, noted in ((255, False), (90, True)):
        values = [(*pair, color, color, color) for pair in UV]
        found = read(tmp_path, ply(textured(extra=rgb, values=values), comments=TEXTURED))
        assert found.corner_colors is None
        assert found.materials[0].base_color_rgba == (1.0, 1.0, 1.0, 1.0)
        assert ("has a texture and colours; drawn with the texture alone" in found.notes) == noted


def test_missing_texture_is_refused_or_the_colours_are_drawn(tmp_path):
    with pytest.raises(ObjectError, match=r"texture 'tex.png' is missing; expected an image of that name"):
        read(tmp_path, ply(textured(), comments=TEXTURED))
    rgb = [("uchar", "red"), ("uchar", "green"), ("uchar", "blue")]
    values = [(*pair, 255, 0, 0) for pair in UV]
    found = read(tmp_path, ply(textured(extra=rgb, values=values), comments=TEXTURED))
    assert found.corner_colors is not None
    assert found.notes == ("texture 'tex.png' is missing; drawn with the colours instead",)


def test_texture_without_coordinates_is_noted(tmp_path):
    found = read(tmp_path, ply(mesh_of(), comments=TEXTURED))
    assert found.notes == ("texture 'tex.png' is not drawn: there are no texture coordinates",)


def test_huge_texture_is_refused_unread(tmp_path):
    (tmp_path / "tex.png").write_bytes(b"\0" * 1_100_000)
    with pytest.raises(ObjectError, match=r"tex.png: has 1 MB; expected at most 1 MB"):
        read(tmp_path, ply(textured(), comments=TEXTURED))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", ["int", "uint"])
def test_tristrips(tmp_path, form, kind):
    """Two strips in one row and one in another; every second triangle is turned over."""
    gap = 2**32 - 1 if kind == "uint" else -1
    strips = [([0, 1, 2, 3, gap, 3, 2, 0],), ([1, 0, 3],)]
    elements = [("vertex", XYZ, VERTS), ("tristrips", [(("int", kind), "vertex_indices")], strips)]
    found = read(tmp_path, ply(elements, form))
    np.testing.assert_array_equal(found.faces, [[0, 1, 2], [1, 3, 2], [3, 2, 0], [1, 0, 3]])


POINTS = [("vertex", XYZ, VERTS)]
SPLAT = ["f_dc_0", "opacity", "scale_0", "scale_1", "rot_0", "rot_1"]


TEXT, BYTES = ply(mesh_of()), ply(mesh_of(), "binary_little_endian")
FACES = ("face", INDICES, [(face,) for face in TETRA])
RGB_FLOAT = [("float", "red"), ("float", "green"), ("float", "blue")]
NAN = float("nan")
NAN_VERTS = [(NAN, 0, 0), *VERTS[1:]]
WEDGES = [(("uchar", "float"), "texcoord")]


def splat() -> bytes:
    properties = [*XYZ, *(("float", name) for name in SPLAT)]
    return ply([("vertex", properties, [(*vert, *[0.1] * len(SPLAT)) for vert in VERTS])])


def promising(vertex: int, face: int) -> bytes:
    """A header of so many vertices and faces above 99 bytes."""
    text = "ply\nformat binary_little_endian 1.0\n"
    text += f"element vertex {vertex}\nproperty float x\nproperty float y\nproperty float z\n"
    text += f"element face {face}\nproperty list uchar int vertex_indices\nend_header\n"
    return text.encode() + b"\0" * 99


def signed_lengths(length: int) -> bytes:
    """A face whose list of three is announced with another length, of type char."""
    data = ply(
        [*POINTS, ("face", [(("char", "int"), "vertex_indices")], [((0, 1, 2),)])], "binary_little_endian"
    )
    return data[:-13] + struct.pack("b", length) + data[-12:]


BAD = {
    "splat": (splat(), r"is a gaussian splat, not a mesh: it has no faces \(4 vertices\)"),
    "packed splat": (ply([("vertex", [("uint", "packed_position")], [(7,)])]), "is a gaussian splat"),
    "points": (ply(POINTS), r"is a point cloud, not a mesh: it has no faces \(4 vertices\)"),
    "points and no faces": (ply([*POINTS, ("face", INDICES, [])]), "is a point cloud"),
    "curve": (ply([*POINTS, ("edge", [("int", "vertex1")], [(0,)])]), "is not a mesh: it has no faces"),
    "nothing": (ply([]), r"is not a mesh: it has no faces \(0 vertices\)"),
    "no magic": (b"hello", "is not a PLY file"),
    "no end of header": (b"ply\nformat ascii 1.0\nelement vertex 3\n", "has no line 'end_header'"),
    "odd format": (b"ply\nformat zip 1.0\nend_header\n", "states no format that is known"),
    "no format": (TEXT.replace(b"format ascii 1.0\n", b""), "states no format that is known"),
    "odd type": (
        TEXT.replace(b"float y", b"complex y"),
        "header line 5 cannot be read: 'property complex y'",
    ),
    "odd count": (TEXT.replace(b"vertex 4", b"vertex four"), "header line 3 cannot be read"),
    "negative count": (TEXT.replace(b"vertex 4", b"vertex -4"), "header line 3 cannot be read"),
    "endless count": (TEXT.replace(b"vertex 4", b"vertex " + b"4" * 5000), "header line 3 cannot be read"),
    "two elements of a name": (
        TEXT.replace(b"element face", b"element VERTEX"),
        "header line 7 cannot be read",
    ),
    "stray property": (
        b"ply\nformat ascii 1.0\nproperty float x\nend_header\n",
        "header line 3 cannot be read",
    ),
    "index beyond": (ply(mesh_of(faces=[(0, 1, 9)])), "a face names vertex 9 of 4"),
    "negative index": (ply(mesh_of(faces=[(0, 1, -2)])), "a face names vertex -2 of 4"),
    "broken index": (TEXT.replace(b"3 0 2 1", b"3 0 2.5 1"), "a face names vertex 2.5 of 4"),
    "broken length": (TEXT.replace(b"3 0 2 1", b"3.5 0 2 1"), "a list of element 'face' has 3.5 entries"),
    "negative length": (signed_lengths(-3), "a list of element 'face' has -3 entries"),
    "cut text": (TEXT[:-10], "is cut short: its body ends within element 'face'; expected 4 of 'face'"),
    "cut bytes": (BYTES[:-10], "is cut short: its body ends within element 'face'"),
    "cut in vertices": (BYTES[:-70], "is cut short: its body ends within element 'vertex'"),
    "billions of vertices": (
        promising(4_000_000_000, 1),
        "is cut short: its body ends within element 'vertex'",
    ),
    "billions of faces": (promising(1, 4_000_000_000), "is cut short: its body ends within element 'face'"),
    "more numbers": (TEXT + b"3 0 1 2\n", "holds 4 numbers more than its header announces"),
    "more bytes": (BYTES + b"\3\1\1\1", "holds 4 bytes more than its header announces"),
    "decimal comma": (TEXT.replace(b"0.1", b"0,1"), "writes its numbers with a decimal comma .'0,1'."),
    "word": (TEXT.replace(b"3 0 2 1", b"3 0 two 1"), "has 'two' among its numbers"),
    "no positions": (ply([("vertex", XYZ[:1], [(0,)] * 4), FACES]), "has no vertices with x, y and z"),
    "no vertices": (ply([FACES]), "has no vertices with x, y and z"),
    "no indices": (
        ply([*POINTS, ("face", [("uchar", "flags")], [(1,)])]),
        "has faces without vertex indices",
    ),
    "NaN": (ply(mesh_of(NAN_VERTS)), "1 of 4 vertices are NaN"),
    "NaN in a quad": (ply(mesh_of(NAN_VERTS, [(0, 1, 2, 3)])), "1 of 4 vertices are NaN"),
    "NaN colour": (
        ply(mesh_of(extra=RGB_FLOAT, values=[(NAN, 0, 0)] * 4)),
        "a colour of a vertex is out of range",
    ),
    "odd wedges": (
        ply(mesh_of(face_extra=WEDGES, face_values=[([0, 0],)] * 4), comments=TEXTURED),
        "a 'texcoord' list does not fit the corners of its face",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_get_one_clear_line(case, tmp_path):
    data, message = BAD[case]
    path = tmp_path / "a.ply"
    path.write_bytes(data)
    with pytest.raises(ObjectError, match=message) as caught:
        read_object(path, CONFIG)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("form", FORMS)
def test_damage_anywhere_never_ends_in_another_error(tmp_path, form):
    rgb = [("uchar", "red"), ("uchar", "green"), ("uchar", "blue")]
    whole = ply(
        mesh_of(faces=[*TETRA, (0, 2, 1, 3)], extra=rgb, values=[(1, 2, 3)] * 4), form, comments=TEXTURED
    )
    # Files that are cut in their first half have at most half of the mesh.
    assert refusals(whole, partial(read, tmp_path)) >= len(whole) // 2
