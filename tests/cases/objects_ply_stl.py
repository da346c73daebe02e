"""The case folders of PLY, STL and sizes: what is right of each."""

import functools
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from datagen.objects.errors import ObjectError
from datagen.objects.formats.reading import ReadingConfig, ReadObject, read_object
from datagen.objects.mesh.surface_points import sample_surface
from datagen.objects.stores.folder import MeshFolder
from datagen.objects.stores.library import REFERENCE_READING
from datagen.objects.watertight.preparation import REFERENCE_PREPARATION
from tests.cases.outcome import Case

__all__ = ["CASES"]

IN_METRES = ReadingConfig(unit="m", up_axis="z", max_faces=5000, max_image_px=4096)


def _colors(read: ReadObject) -> np.ndarray:
    """Display colours (0..1) of points on the surface."""
    return sample_surface(read.mesh, 300, np.random.default_rng(0)).colors


def _refused(path: Path, *words: str, reading: ReadingConfig = IN_METRES) -> str:
    """The one line of a refusal, with all of `words` in it."""
    try:
        read_object(path, reading)
    except ObjectError as error:
        line = str(error)
        if "\n" not in line and all(word in line for word in words):
            return line
        raise
    raise AssertionError(f"{path.name} was read")


def _same_colour(name: str, shown: tuple[float, float, float], n_faces: int, folder: Path) -> str:
    read = read_object(folder / name, IN_METRES)
    assert len(read.mesh.faces) == n_faces, f"{len(read.mesh.faces)} triangles"
    colors = _colors(read)
    assert np.abs(colors - shown).max() < 0.01, f"colours around {colors.mean(axis=0)}"
    return f"{n_faces} triangles, colour {colors.mean(axis=0).round(2).tolist()}"


def _bop_texture(folder: Path) -> str:
    read = read_object(folder / "obj_000001.ply", IN_METRES)
    image = read.mesh.materials[0].base_color_image
    assert image == (folder / "tex.png").read_bytes(), "the image is not the file's"
    assert np.ptp(read.mesh.corner_uv.reshape(-1, 2), axis=0).tolist() == [1, 1], (
        "texture coordinates are lost"
    )
    lowest, highest = (
        bound.round(2).tolist() for bound in (_colors(read).min(axis=0), _colors(read).max(axis=0))
    )
    return f"textured, colours from {lowest} to {highest}"


def _tetrahedron(names: tuple[str, ...], folder: Path) -> str:
    """Each file is the tetrahedron between the origin and 0.1 m along the axes: volume 1/6000 m³."""
    notes: list[str] = []
    for name in names:
        read = read_object(folder / name, IN_METRES)
        corners = read.mesh.verts_obj[read.mesh.faces] - read.mesh.verts_obj.min(axis=0)
        volume = float(np.linalg.det(corners).sum() / 6)
        assert len(read.mesh.faces) == 4, f"{name}: {len(read.mesh.faces)} triangles"
        assert abs(abs(volume) - 1e-3 / 6) < 1e-9, f"{name}: volume {volume}"
        notes += read.notes
    return "; ".join([f"4 triangles in {', '.join(names)}", *notes])


def _two_solids(folder: Path) -> str:
    assert len(read_object(folder / "two.stl", IN_METRES).mesh.faces) == 8
    return "8 triangles"


def _nan(folder: Path) -> str:
    found = _tetrahedron(("nan_normal.stl",), folder)
    return f"{found}; {_refused(folder / 'nan_vertex.stl', 'NaN')}"


def _counts(folder: Path) -> str:
    found = _tetrahedron(("count_zero.stl", "trailing.stl"), folder)
    return f"{found}; {_refused(folder / 'count_large.stl', '9 triangles', '4 follow')}"


def _millimetres(folder: Path) -> str:
    lines = []
    for name, size_m in (
        ("mug_95mm", 0.095),
        ("die_16mm", 0.016),
        ("bottle_180mm", 0.18),
        ("ring_1_8mm", 0.018),
    ):
        read = read_object(folder / f"{name}.stl", REFERENCE_READING)
        longest_m = float(np.ptp(read.mesh.verts_obj, axis=0).max())
        assert abs(longest_m - size_m) < 1e-6, f"{name} is {longest_m} m long"
        assert bool(read.notes) == (name != "bottle_180mm"), read.notes
        lines += [f"{name}: {note}" for note in read.notes]
    _refused_in_millimetres(folder / "ring_1_8mm.stl")
    return "; ".join(lines)


def _refused_in_millimetres(path: Path) -> None:
    """The unit that the file was made in, stated: too small for a hand."""
    reading = ReadingConfig(unit="mm", up_axis="z", max_faces=5000, max_image_px=4096)
    _refused_by_size(path, reading)


def _refused_by_size(path: Path, reading: ReadingConfig) -> str:
    """By the folder that `datagen select` opens, before any watertight mesh is made."""
    with TemporaryDirectory() as cache:
        library = MeshFolder(path.parent, reading, REFERENCE_PREPARATION, Path(cache))
        try:
            library.measure(f"folder/{path.stem}")
        except ObjectError as error:
            line = str(error)
            if "has a longest side of" in line:
                return line
            raise
    raise AssertionError(f"{path.name} was accepted")


def _sizes(folder: Path) -> str:
    names = ("micro.glb", "house.glb", "planet.glb")
    return "; ".join(_refused_by_size(folder / name, REFERENCE_READING) for name in names)


CASES: tuple[Case, ...] = (
    Case(
        folder="p01_big_endian_quads_uchar",
        what="12 triangles of 6 quads, sRGB 128",
        check=functools.partial(_same_colour, "be.ply", (128 / 255,) * 3, 12),
    ),
    Case(folder="p02_bop_texture_file", what="textured by its comment", check=_bop_texture),
    Case(
        folder="p03_float_colours",
        what="sRGB 0.5",
        check=functools.partial(_same_colour, "float.ply", (0.5,) * 3, 4),
    ),
    Case(folder="p04_tristrips", what="meshed", check=functools.partial(_tetrahedron, ("strips.ply",))),
    Case(
        folder="p05_gaussian_splat",
        what="named for what it is",
        check=lambda folder: _refused(folder / "splat.ply", "gaussian splat", "50 vertices"),
    ),
    Case(
        folder="p06_crlf_and_latin1_header",
        what="read",
        check=functools.partial(_tetrahedron, ("crlf.ply", "crlf_binary.ply")),
    ),
    Case(folder="s01_two_solids", what="8 triangles", check=_two_solids),
    Case(
        folder="s02_binary_begins_with_solid",
        what="4 triangles",
        check=functools.partial(_tetrahedron, ("solid.stl",)),
    ),
    Case(folder="s03_nan", what="harmless in a normal, named in a vertex", check=_nan),
    Case(
        folder="s04_dialects",
        what="read",
        check=functools.partial(
            _tetrahedron,
            ("crlf.stl", "leading_blank.stl", "leading_space.stl", "no_end.stl", "tabs.stl", "upper.stl"),
        ),
    ),
    Case(folder="s05_count_and_trailing", what="read with a note, or said to be cut short", check=_counts),
    Case(folder="s06_millimetres", what="recognised, and a note where it is a guess", check=_millimetres),
    Case(
        folder="s07_colour",
        what="red",
        check=functools.partial(_same_colour, "viscam.stl", (1.0, 0.0, 0.0), 4),
    ),
    Case(folder="g17_sizes", what="refused by size in the selection", check=_sizes),
)
