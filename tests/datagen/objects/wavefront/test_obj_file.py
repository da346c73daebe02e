"""OBJ as exporters write it: text, numbers, polygons, colours."""

import numpy as np
import pytest

from datagen.objects.errors import ObjectError
from datagen.objects.mesh.surface_points import face_normals
from datagen.objects.wavefront.obj_elements import BLOCK_LINES
from shards.color import linear_from_srgb

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def volume(mesh) -> float:
    a, b, c = (mesh.verts_file[mesh.faces[:, k]] for k in range(3))
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)


def area_vector(mesh) -> np.ndarray:
    a, b, c = (mesh.verts_file[mesh.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a).sum(axis=0) / 2


WRITTEN = {
    "as it should be": lambda text: text,
    "tabs": lambda text: text.replace(" ", "\t"),
    "runs of blanks": lambda text: text.replace(" ", "  \t ").replace("\n", " \n   "),
    "Windows": lambda text: text.replace("\n", "\r\n"),
    "old Mac": lambda text: text.replace("\n", "\r"),
    "no newline at the end": str.rstrip,
    "UTF-8 with a mark": lambda text: text.encode("utf-8-sig"),
    "UTF-16": lambda text: text.encode("utf-16"),
    "UTF-16 big-endian": lambda text: b"\xfe\xff" + text.encode("utf-16-be"),
    "UTF-16 without a mark": lambda text: text.encode("utf-16-le"),
    "UTF-16 big-endian without a mark": lambda text: text.encode("utf-16-be"),
    "UTF-32": lambda text: text.encode("utf-32"),
    "zeros at the end": lambda text: text.encode() + b"\0" * 100,
    "Latin-1": lambda text: f"# Küche\no Küche\n{text}".encode("latin-1"),
    "comments behind": lambda text: text.replace("\n", " # corner 9\n"),
    "comments glued": lambda text: text.replace("\n", "#corner\n"),
    "one comment": lambda text: text.replace("0.1 0 0\n", "0.1 0 0 # corner\n"),
    "a comment that ends in a backslash": lambda text: "# from C:\\models\\\n" + text,
    "continued": lambda text: text.replace("f 1 3 2", "f 1 \\\n3 \\  \n2"),
    "exponents": lambda text: text.replace("0.1", "1e-1"),
    "plus signs": lambda text: text.replace("0.1", "+.1").replace("f 1", "f +1"),
    "faces first": lambda text: text[text.index("f") :] + text[: text.index("f")],
    "negative": lambda text: text.replace("f 1 3 2", "f -4 -2 -3").replace("f 2 3 4", "f -3 -2 -1"),
    "normals": lambda text: "vn 0 0 1\n" + text.replace("f 1 3 2", "f 1//1 3//1 2//1"),
    "all with normals": lambda text: (
        "vn 0 0 1\n"
        + "\n".join(
            " ".join(f"{w}//1" if line[0] == "f" and w != "f" else w for w in line.split())
            for line in text.splitlines()
        )
    ),
    "slashes at the end": lambda text: text.replace("f 1 3 2", "f 1/ 3// 2"),
    "UV index 0": lambda text: "vt 0 0\n" + text.replace("f 1 3 2", "f 1/0 3/0 2/0"),
    "UVs that are not there": lambda text: text.replace("f 1 3 2", "f 1/1 3/3 2/2"),
    "normals that are no numbers": lambda text: "vn nan 1.#QNAN -1.#IND\n" + text,
    "other kinds of lines": lambda text: f"o a\ng b c\ns off\nvp 0 0\ncstype bezier\n\x0c\n{text}end\n",
    "weights": lambda text: text.replace("0\nv", "0 1.0\nv"),
    "zero-area faces": lambda text: text + "f 1 1 2\nf 1 2\nf 1\n",
    "an unused vertex that is no number": lambda text: text + "v nan 0 -nan(ind)\n",
}


@pytest.mark.parametrize("kind", WRITTEN)
def test_the_same_tetrahedron_however_it_is_written(kind, obj, tetrahedron):
    mesh = obj(WRITTEN[kind](tetrahedron))
    assert mesh.faces.tolist() == [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    assert volume(mesh) == pytest.approx(0.1**3 / 6)
    assert [material.name for material in mesh.materials] == ["unnamed"]
    np.testing.assert_allclose(mesh.materials[0].base_color_rgba[:3], linear_from_srgb(np.full(3, 0.6)))
    assert mesh.notes == ()


def test_lines_are_counted_through_continuations(obj, tetrahedron):
    with pytest.raises(ObjectError, match="line 4 cannot be read: 'v 0 x 0'"):
        obj("# one\\\nf 1 \\\n2 3\nv 0 x 0\n" + tetrahedron)


FAULTS = {
    "decimal comma": ("v 0,1 0 0\n", "line 1 .*'0,1' has a decimal comma"),
    "grouping": ("v 1_000 0 0\n", "line 1 .*'1_000' is not a number"),
    "two numbers": ("v 0 0 0\nv 0 0\n", "line 2 .*fewer than 3 numbers"),
    "no number": ("v\n", "line 1 .*no numbers"),
    "index 0": (SQUARE + "f 0 1 2\n", "line 5 .*count from 1"),
    "beyond": (SQUARE + "f 1 2 3\nf 1 2 5\n", "line 6 .*index 5 of 4"),
    "beyond all": (SQUARE + "f 1 2 99999999999999999999\n", "line 5 cannot be read"),
    "back beyond": (SQUARE + "f -1 -2 -5\n", "line 5 .*index -5 of 4"),
    "UV beyond": (SQUARE + "vt 0 0\nf 1/1 2/2 3/1\n", "line 6 .*index 2 of 1"),
    "fraction": (SQUARE + "f 1 2 3.5\n", "line 5 .*'3.5' is no corner"),
    "joined": (SQUARE + "f 1 2-3 4\n", "line 5 .*'2-3' is no corner"),
    "four slashes": (SQUARE + "f 1/1/1/1 2 3\n", "line 5 .*is no corner"),
    "a program": (b"L\x01\x02\x00\x00\x00\x00\x00.text\0\0\0", "is not text"),
    "a web page": ("<!DOCTYPE html>\n<html>\n", "no faces and no vertices .*begins with '<!DOCTYPE html>'"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named_with_their_line(fault, obj):
    text, message = FAULTS[fault]
    with pytest.raises(ObjectError, match=message) as caught:
        obj(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("word", ["nan", "-nan", "NaN", "1.#QNAN", "-1.#IND", "1.#INF00", "nan(ind)", "inf"])
def test_what_is_no_number_never_becomes_one(word, obj):
    mesh = obj(f"v 0 0 {word}\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert not np.isfinite(mesh.verts_file[0, 2])  # `read_object` refuses it


def test_a_file_of_many_blocks_keeps_order_and_counts(obj):
    """Quads of a strip, negative indices in half of them, an odd line in the midst."""
    count = BLOCK_LINES // 2 + 10
    pairs = "".join(f"v {k} 0 0\nv {k} 1 0\n" for k in range(count))
    quads = [f"f {2 * k + 1} {2 * k + 3} {2 * k + 4} {2 * k + 2}" for k in range(count - 1)]
    for k in range(1, count - 1, 2):
        back = [2 * k - 2 * count + offset for offset in (0, 2, 3, 1)]
        quads[k] = "f " + " ".join(map(str, back))
    quads[77] += " # a comment"
    mesh = obj(pairs + "\n".join(quads), max_file_mb=10.0)
    assert len(mesh.faces) == 2 * (count - 1)
    np.testing.assert_array_equal(mesh.faces[::2, 0] // 2, np.arange(count - 1))
    np.testing.assert_allclose(area_vector(mesh), [0, 0, count - 1])


def test_two_triangles_of_one_kind_of_line_do_not_hide_an_uneven_pair(obj):
    """Four and two corners are not three and three."""
    mesh = obj(SQUARE + "v 2 0 0\nf 1 2 3 4\nf 2 5\n")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]


POLYGONS: dict[str, tuple[list[tuple[float, float]], float]] = {  # corners in the plane, area
    "square": ([(0, 0), (1, 0), (1, 1), (0, 1)], 1.0),
    "dart": ([(0, 0), (2, -1), (0, 3), (0.5, 0)], 2.25),
    "L": ([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], 3.0),
    "corner doubled": ([(0, 0), (2, 0), (2, 1), (1, 1), (1, 1), (1, 2), (0, 2)], 3.0),
    "corner on an edge": ([(0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], 3.0),
    "star": (
        [(np.cos(k * np.pi / 5) * (2 - k % 2), np.sin(k * np.pi / 5) * (2 - k % 2)) for k in range(10)],
        10 * np.sin(np.pi / 5),
    ),
    "hole joined by a seam": (
        [(0, 0), (3, 0), (3, 3), (0, 3), (0, 0), (1, 1), (1, 2), (2, 2), (2, 1), (1, 1)],
        8.0,
    ),
}


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("size", [1e-4, 1.0])
@pytest.mark.parametrize("name", POLYGONS)
def test_polygons_keep_area_and_side(name, size, axis, obj):
    flat, area = POLYGONS[name]
    corners = np.insert(np.array(flat) * size, axis, 100 * size, axis=1)
    text = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in corners.tolist())
    mesh = obj(text + "f " + " ".join(str(k + 1) for k in range(len(flat))) + "\n")
    expected = np.zeros(3)
    expected[axis] = area * size**2 * (-1 if axis == 1 else 1)
    np.testing.assert_allclose(area_vector(mesh), expected, rtol=1e-6, atol=1e-9 * size**2)
    normals = face_normals(mesh.verts_file, mesh.faces)[:, axis] * np.sign(expected[axis])
    assert (normals > -1e-9).all()


def test_polygons_without_a_plane_end_in_no_traceback(obj):
    bow_tie = "v 0 0 0\nv 1 1 0\nv 1 0 0\nv 0 1 0\nv nan 0 0\n"
    mesh = obj(bow_tie + "f 1 2 3 4\nf 1 2 1 2\nf 1 2 5 3 4\n")
    assert set(np.unique(mesh.faces)) <= set(range(5))


COLORS: dict[
    str, tuple[list[str], list[tuple[float, float, float]]]
] = {  # what stands behind x y z of four vertices, display colours that it means
    "floats": (
        ["0.5 0.5 0.5", "1 0 0", "0 1 0", "0 0 1"],
        [(0.5, 0.5, 0.5), (1, 0, 0), (0, 1, 0), (0, 0, 1)],
    ),
    "integers": (
        ["128 128 128", "255 0 0", "0 51 0", "0 0 1"],
        [(128 / 255,) * 3, (1, 0, 0), (0, 0.2, 0), (0, 0, 1 / 255)],
    ),
    "zeros and ones": (["1 1 1", "1 0 0", "0 1 0", "0 0 0"], [(1, 1, 1), (1, 0, 0), (0, 1, 0), (0, 0, 0)]),
    "16 bits": (["65535 0 0"] * 4, [(1, 0, 0)] * 4),
    "with alpha": (["0.5 0.25 0 1"] * 4, [(0.5, 0.25, 0)] * 4),
    "with alpha, red": (["1 0 0 1"] * 4, [(1, 0, 0)] * 4),
    "behind a weight": (["1 0.5 0.25 0"] * 4, [(0.5, 0.25, 0)] * 4),
    "brighter than white": (["1.5 0.5 0"] * 4, [(1, 0.5, 0)] * 4),
}


@pytest.mark.parametrize("kind", COLORS)
def test_vertex_colours_are_display_colours_on_a_white_base(kind, obj):
    behind, display = COLORS[kind]
    lines = [f"{line} {color}\n" for line, color in zip(SQUARE.splitlines(), behind)]
    mesh = obj("".join(lines) + "f 1 2 3 4\n")
    np.testing.assert_allclose(mesh.corner_colors, linear_from_srgb(np.array(display, float))[mesh.faces])
    assert mesh.materials[0].base_color_rgba == (1.0, 1.0, 1.0, 1.0)


def test_faces_without_colours_keep_their_grey_beside_coloured_ones(obj):
    mesh = obj("v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\n" + SQUARE + "f 1 2 3\nf 4 5 6\n")
    np.testing.assert_allclose(mesh.corner_colors[0], [[1, 0, 0]] * 3)
    shown = mesh.corner_colors[1] * mesh.materials[mesh.face_material[1]].base_color_rgba[:3]
    np.testing.assert_allclose(shown, linear_from_srgb(np.full((3, 3), 0.6)))


def test_normals_behind_coordinates_are_no_colours(obj):
    mesh = obj(SQUARE.replace("\n", " 0 0 -1\n") + "f 1 2 3 4\n")
    assert mesh.corner_colors is None
    assert "negative" in " ".join(mesh.notes)


def test_polypaint_of_zbrush(obj):
    mesh = obj(SQUARE + "#MRGB ffff0000ff00ff00\n#MRGB ff0000ffffffffff\nf 1 2 3 4\n")
    np.testing.assert_array_equal(mesh.corner_colors[0], [[1, 0, 0], [0, 1, 0], [0, 0, 1]])


def test_texture_coordinates_stay_with_their_corners(obj):
    uvs = "vt 0.5\nvt 1 0\nvt 1 1 0\nvt nan nan\n"
    mesh = obj(SQUARE + uvs + "f 1/1 2/2 3/3\nf 1/-1 3/3 4\nf 1/4/7 3/3/7 4/2/7\n")
    np.testing.assert_array_equal(mesh.corner_uv[0], np.array([[0.5, 0], [1, 0], [1, 1]]))
    np.testing.assert_array_equal(mesh.corner_uv[1], np.zeros((3, 2)))  # one corner has none
    np.testing.assert_array_equal(mesh.corner_uv[2], [[0, 0], [1, 1], [1, 0]])
    assert mesh.notes == ("1 texture coordinates are no finite numbers and count as 0",)


def test_curves_lines_and_points_are_left_out_with_a_note(obj, tetrahedron):
    mesh = obj(tetrahedron + "l 1 2\nl 2 3\np 1\ncurv 0 1 1 2\ncall b.obj\n")
    assert len(mesh.faces) == 4
    assert mesh.notes == ("left out: 2 x 'l', 1 x 'p', 1 x 'curv', 1 x 'call' (only 'f' is read)",)


def test_a_hostile_line_takes_no_memory(obj):
    mesh = obj(SQUARE + "v 0 0 0 " + "0 " * 200_000 + "\n" + "v 1 1 1\n" * 1000 + "f 1 2 3\n")
    assert len(mesh.verts_file) == 1005
