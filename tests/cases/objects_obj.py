"""OBJ and MTL as they are found in the field."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from datagen.objects.errors import ObjectError
from datagen.objects.formats.reading import ReadingConfig, ReadObject, read_object
from datagen.objects.mesh.surface_points import sample_surface
from shards.color import linear_from_srgb, srgb_from_linear
from tests.cases.outcome import Case

__all__ = ["CASES"]

READING = ReadingConfig(unit="m", up_axis="y", max_faces=1_000, max_image_px=1_024)
TETRAHEDRON_M3 = 0.1**3 / 6
CUBE_M3 = 0.1**3


def _told(read: ReadObject, line: str) -> str:
    return "; ".join((line, *read.notes))


def _volume_m3(read: ReadObject) -> float:
    a, b, c = (read.mesh.verts_obj[read.mesh.faces[:, k]] for k in range(3))
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)


def _shape(name: str, volume_m3: float, faces: int, folder: Path) -> str:
    read = read_object(folder / name, READING)
    assert len(read.mesh.faces) == faces, f"{len(read.mesh.faces)} triangles instead of {faces}"
    assert np.isclose(_volume_m3(read), volume_m3), f"volume {_volume_m3(read):g} instead of {volume_m3:g}"
    return _told(read, f"{faces} triangles")


def _kd(name: str, colors: tuple[tuple[float, float, float], ...], folder: Path) -> str:
    """Display colours of the materials, one for each."""
    read = read_object(folder / name, READING)
    found = [srgb_from_linear(np.array(m.base_color_rgba[:3])) for m in read.mesh.materials]
    assert np.allclose(found, colors, atol=1e-6), f"colours {np.round(found, 3).tolist()}"
    return _told(read, f"{len(found)} materials in their colours")


def _texture(subfolder: str, folder: Path) -> str:
    (image,) = (folder / subfolder).rglob("*.png")
    read = read_object(folder / subfolder / "a.obj", READING)
    assert read.mesh.materials[0].base_color_image == image.read_bytes(), "the texture is lost"
    return _told(read, f"{image.name} is the texture")


def _vertex_grey(name: str, folder: Path) -> str:
    read = read_object(folder / name, READING)
    colors = sample_surface(read.mesh, 100, np.random.default_rng(0)).colors
    assert np.allclose(colors, 0.5, atol=0.01), f"sRGB {colors.mean():.3f} instead of 0.50"
    return _told(read, f"sRGB {colors.mean():.2f}")


def _opaque(name: str, *, noted: bool, folder: Path) -> str:
    read = read_object(folder / name, READING)
    (material,) = read.mesh.materials
    assert material.transmission == 0.0, "became glass"
    red = linear_from_srgb(np.array([0.8, 0.1, 0.1]))
    assert np.allclose(material.base_color_rgba[:3], red), f"colour {material.base_color_rgba}"
    assert bool(read.notes) is noted, f"notes {read.notes}"
    return _told(read, "opaque")


def _invisible(folder: Path) -> str:
    read = read_object(folder / "d_zero.obj", READING)
    assert read.notes, "drawn as glass without a word"
    return _told(read, "glass")


def _comma(folder: Path) -> str:
    try:
        read_object(folder / "comma.obj", READING)
    except ObjectError as error:
        if "line 2" in str(error) and "decimal comma" in str(error):
            raise
        raise AssertionError(f"another refusal: {error}") from error
    raise AssertionError("decimal commas were read")


def _case(folder: str, what: str, check: Callable[[Path], str], *, refused: bool = False) -> Case:
    return Case(folder=folder, what=what, check=check, refused_is_right=refused)


TEXTURE_KINDS = (
    "space",
    "option_space",
    "hash",
    "windows",
    "case",
    "quotes",
    "backslash",
    "bm_option",
    "clamp_on",
)

CASES: tuple[Case, ...] = (
    _case("o01_tabs", "tabs", partial(_shape, "tabs.obj", TETRAHEDRON_M3, 4)),
    _case("o02_bom_before_mtllib", "BOM", partial(_kd, "bom.obj", ((0.9, 0.05, 0.05),))),
    _case("o04_utf16", "UTF-16", partial(_shape, "utf16.obj", TETRAHEDRON_M3, 4)),
    _case("o05_two_libraries_on_a_line", "two libraries", partial(_kd, "two.obj", ((1, 0, 0), (0, 0, 1)))),
    _case("o06_hash_in_material_name", "'#' in a name", partial(_kd, "hash.obj", ((1, 0, 0),))),
    _case("o07_double_space_in_material_name", "two blanks in a name", partial(_kd, "sp.obj", ((1, 0, 0),))),
    *(_case("o08_texture_names", kind, partial(_texture, kind)) for kind in TEXTURE_KINDS),
    _case("o09_vertex_colours", "floats", partial(_vertex_grey, "float.obj")),
    _case("o09_vertex_colours", "integers", partial(_vertex_grey, "int255.obj")),
    _case("o09_vertex_colours", "the same PLY", partial(_vertex_grey, "same.ply")),
    _case("o10_tr_means_opacity", "Tr 1", lambda folder: _opaque("tr_only.obj", noted=True, folder=folder)),
    _case("o10_tr_means_opacity", "Tr 0", lambda folder: _opaque("tr_zero.obj", noted=False, folder=folder)),
    _case("o10_tr_means_opacity", "d 1, Tr 1", lambda folder: _opaque("both.obj", noted=True, folder=folder)),
    _case("o10_tr_means_opacity", "d 1, Tr 0", lambda folder: _opaque("max.obj", noted=False, folder=folder)),
    _case("o10_tr_means_opacity", "d 0", _invisible),
    _case("o11_ngons", "continuation", partial(_shape, "continuation.obj", CUBE_M3, 12)),
    _case("o11_ngons", "a corner twice", partial(_shape, "doubled_corner.obj", CUBE_M3, 12)),
    _case("o11_ngons", "negative indices", partial(_shape, "neg_quads.obj", CUBE_M3, 12)),
    _case("o12_faces_before_vertices", "faces first", partial(_shape, "late.obj", TETRAHEDRON_M3, 4)),
    _case("o13_decimal_comma", "decimal commas", _comma, refused=True),
    _case("o14_kinds_of_lines", "other lines", partial(_shape, "lines.obj", TETRAHEDRON_M3, 4)),
)
