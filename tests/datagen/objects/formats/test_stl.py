"""STL of many writers: dialects of text, counts that lie, colours, and what is no mesh."""

import struct
from functools import partial

import numpy as np
import pytest

from datagen.objects.errors import ObjectError
from datagen.objects.formats.reading import ReadingConfig, read_object
from datagen.objects.formats.stl import read_stl
from datagen.objects.mesh.surface_points import sample_surface
from shards.color import linear_from_srgb
from tests.datagen.objects.formats.damage import refusals

CONFIG = ReadingConfig(unit="m", up_axis="z", max_faces=5000, max_image_px=256)
VERTS = np.array([(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.1)], dtype="<f4")
TETRA = VERTS[[(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)]]


def binary(facets=TETRA, *, header=b"made by hand", count=None, attributes=None) -> bytes:
    attributes = [0] * len(facets) if attributes is None else attributes
    body = b"".join(
        struct.pack("<3f", 0, 0, 0) + facet.tobytes() + struct.pack("<H", attribute)
        for facet, attribute in zip(facets, attributes, strict=True)
    )
    return header.ljust(80) + struct.pack("<I", len(facets) if count is None else count) + body


def text(facets=TETRA, *, name="part", normal="0 0 0", number="{:e}".format) -> bytes:
    lines = [f"solid {name}"]
    for facet in facets:
        lines += [f"  facet normal {normal}", "    outer loop"]
        lines += [f"      vertex {' '.join(map(number, corner))}" for corner in facet]
        lines += ["    endloop", "  endfacet"]
    return ("\n".join([*lines, f"endsolid {name}"]) + "\n").encode()


def read(tmp_path, data: bytes):
    return read_stl(tmp_path / "a.stl", data)


def corners(mesh):
    return mesh.verts_file[mesh.faces]


DIALECTS = {
    "plain": text(),
    "upper case": text().upper(),
    "tabs": text().replace(b"      ", b"\t\t\t").replace(b" ", b"\t"),
    "CRLF": text().replace(b"\n", b"\r\n"),
    "CR": text().replace(b"\n", b"\r"),
    "one line": text(name="").replace(b"\n", b" "),
    "no indentation": b"\n".join(line.strip() for line in text().splitlines()),
    "leading blank": b"\n\n  " + text(),
    "byte order mark": b"\xef\xbb\xbf" + text(),
    "UTF-16": text().decode().encode("utf-16"),
    "padded": text() + b"\0" * 700,
    "end of file mark": text() + b"\x1a",
    "no name": text(name=""),
    "name of keywords": text(name="solid outer shell facet vertex loop 1 2 3"),
    "name of another encoding": text(name="ßtück").decode().encode("latin-1"),
    "names at every end": text()
    .replace(b"endfacet", b"endfacet part")
    .replace(b"endfacet part", b"endfacet"),
    "decimals": text(number="{:.9f}".format),
    "signs": text(number="{:+.6E}".format),
    "normals of NaN": text(normal="nan nan nan"),
    "normals of Windows": text(normal="-1.#IND00e+00 -nan(ind) 1,5"),
    "no normals": text(normal=""),
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_dialects_of_text(tmp_path, dialect):
    found = read(tmp_path, DIALECTS[dialect])
    np.testing.assert_allclose(corners(found), TETRA, rtol=1e-6)
    assert found.corner_colors is None
    assert found.materials[0].base_color_rgba == (0.6, 0.6, 0.6, 1.0)
    assert found.notes == ()


def test_several_solids_of_text(tmp_path):
    found = read(tmp_path, text(name="a") + text(TETRA + 1, name="b") + b"solid empty\nendsolid empty\n")
    np.testing.assert_allclose(corners(found), [*TETRA, *(TETRA + 1)], rtol=1e-6)


def test_text_without_an_end_is_noted(tmp_path):
    for data in (text().rpartition(b"endsolid")[0], text() + text().rpartition(b"endsolid")[0]):
        found = read(tmp_path, data)
        assert found.notes == ("has no 'endsolid' at its end, so it may have been cut short",)


@pytest.mark.parametrize("header", [b"x", b"solid of bytes", b"solid\nfacet normal outer loop"])
def test_bytes_whatever_their_header(tmp_path, header):
    found = read(tmp_path, binary(header=header))
    np.testing.assert_array_equal(corners(found), TETRA)
    assert found.notes == ()


def test_several_solids_of_bytes(tmp_path):
    data = binary() + binary(TETRA + 1, attributes=[0x8000] * 4)
    found = read(tmp_path, data)
    np.testing.assert_array_equal(corners(found), [*TETRA, *(TETRA + 1)])
    np.testing.assert_array_equal(found.corner_colors[:4], 0.6)  # as plain as without colours
    np.testing.assert_array_equal(found.corner_colors[4:], 0)


@pytest.mark.parametrize(
    ("data", "note"),
    [
        (binary(count=0), "its header states 0 triangles, and 4 follow: all were read"),
        (binary(count=2**32 - 1), "its header states 4,294,967,295 triangles, and 4 follow: all were read"),
        (binary(count=3), "its header states 3 triangles, and 4 follow: all were read"),
        (binary(count=0) + b"\0" * 7, "and 4 follow: all were read but the last 7 bytes"),
        (binary() + b"\0" * 12, "12 bytes after the last triangle were not read"),
        (
            binary(header=b"solid x") + b"attributes: " + bytes(range(200)),
            "212 bytes after the last triangle",
        ),
    ],
)
def test_count_and_length_that_disagree(tmp_path, data, note):
    found = read(tmp_path, data)
    np.testing.assert_array_equal(corners(found), TETRA)
    assert len(found.notes) == 1
    assert note in found.notes[0]


def viscam(red, green, blue):
    return 0x8000 | red << 10 | green << 5 | blue


def magics(red, green, blue):
    return blue << 10 | green << 5 | red


HEADER = b"COLOR=\x10\x20\x30\xff,MATERIAL=" + b"\x7f" * 12
OF_OBJECT = np.array([0x10, 0x20, 0x30]) / 255
RGB31 = [(31, 0, 0), (0, 31, 0), (0, 0, 31), (16, 8, 4)]
SHADES = np.array(RGB31) / 31


@pytest.mark.parametrize(
    ("header", "attributes", "shades"),
    [
        (b"x", [viscam(*rgb) for rgb in RGB31], SHADES),
        (HEADER, [magics(*rgb) for rgb in RGB31], SHADES),
        (HEADER, [0x8000] * 3 + [magics(*RGB31[3])], [OF_OBJECT] * 3 + [SHADES[3]]),
        (HEADER, [0xFFFF] * 4, [OF_OBJECT] * 4),
        (HEADER, [0] * 4, [OF_OBJECT] * 4),
        (HEADER, [0x8000 | magics(*rgb) for rgb in RGB31], SHADES),  # as MeshLab writes
    ],
)
def test_colours_of_bytes(tmp_path, header, attributes, shades):
    found = read(tmp_path, binary(header=header, attributes=attributes))
    expected = linear_from_srgb(np.repeat(np.array(shades)[:, None], 3, axis=1))
    np.testing.assert_allclose(found.corner_colors, expected, rtol=1e-6)
    assert found.materials[0].base_color_rgba == (1.0, 1.0, 1.0, 1.0)


def test_bytes_that_are_no_colours(tmp_path):
    assert read(tmp_path, binary(attributes=[1, 2, 3, 0x7FFF])).corner_colors is None
    mixed = read(tmp_path, binary(attributes=[viscam(31, 0, 0), 0, 0, 0]))
    np.testing.assert_array_equal(mixed.corner_colors[:, 0], [[1, 0, 0]] + [[0.6] * 3] * 3)


def test_drawn_colour_is_the_written_one(tmp_path):
    (tmp_path / "a.stl").write_bytes(binary(attributes=[viscam(31, 0, 16)] * 4))
    colors = sample_surface(read_object(tmp_path / "a.stl", CONFIG).mesh, 50, np.random.default_rng(0)).colors
    np.testing.assert_allclose(colors, [[1, 0, 16 / 31]] * 50, atol=0.01)


def replaced(old: bytes, new: bytes) -> bytes:
    return text(number="{:.1f}".format).replace(old, new, 1)


BAD = {
    "not STL": (b"hello", r"holds no triangles \(no 'outer loop' in its text\)"),
    "a page": (b"<!DOCTYPE html><html>404</html>" * 9, "holds no triangles"),
    "empty text": (b"solid a\nendsolid a\n", "holds no triangles"),
    "empty bytes": (binary(TETRA[:0]), "holds no triangles"),
    "empty bytes of NUL": (b"\1" + b"\0" * 83, "holds no triangles"),
    "header alone": (b"\0\1\2", "is cut short or damaged: 3 bytes are less than the header"),
    "another kind of bytes": (b"PK\3\4" + bytes(range(256)), "is cut short or damaged: its header states"),
    "cut bytes": (binary()[:-30], "is cut short or damaged: its header states 4 triangles, and 3 follow"),
    "count too large": (
        binary(count=9),
        "is cut short or damaged: its header states 9 triangles, and 4 follow",
    ),
    "cut text": (text()[:-60], "is cut short or damaged: triangle 4 has no 'endloop'"),
    "decimal comma": (replaced(b"0.1", b"0,1"), "writes its coordinates with a decimal comma .'0,1'."),
    "word": (replaced(b"0.1", b"one"), "has 'one' among its coordinates"),
    "two vertices": (replaced(b"vertex 0.0 0.0 0.0\n", b"\n"), "triangle 1 has 6 coordinates"),
    "four vertices": (replaced(b"vertex 0.0", b"vertex 1 1 1\nvertex 0.0"), "triangle 1 has 12 coordinates"),
    "NaN in a vertex": (replaced(b"0.1", b"nan"), "1 of 12 vertices are NaN"),
    "NaN in bytes": (
        binary(np.where(TETRA > 0.05, np.float32("nan"), TETRA)),
        "vertices are NaN or infinite",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_get_one_clear_line(case, tmp_path):
    data, message = BAD[case]
    path = tmp_path / "a.stl"
    path.write_bytes(data)
    with pytest.raises(ObjectError, match=message) as caught:
        read_object(path, CONFIG)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("whole", [text(), binary(attributes=[0xFFFF] * 4), binary(header=HEADER)])
def test_damage_anywhere_never_ends_in_another_error(tmp_path, whole):
    # Files that are cut in their first half have at most half of the mesh.
    assert refusals(whole, partial(read, tmp_path)) >= len(whole) // 2
