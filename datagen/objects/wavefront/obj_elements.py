"""The text of an OBJ file to arrays: vertices, polygons, and which material each one has."""

import re
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.objects.errors import ObjectError
from datagen.objects.wavefront.lines import joined_lines, number, shown, without_comment
from datagen.objects.wavefront.obj_vertex_colors import colors_behind_coordinates, polypaint

__all__ = ["ObjElements", "read_elements"]

BLOCK_LINES = 50_000  # read at a time: words take ten times the memory of numbers
CORNER = re.compile(r"([-+]?\d{1,18})(?:/([-+]?\d{1,18})?(?:/(?:[-+]?\d{1,18})?)?)?")
# What draws something and is not read, as opposed to names, groups, normals and hints.
LEFT_OUT = ("l", "p", "curv", "curv2", "surf", "call", "usemap", "bzp", "bsp", "cdc", "cdp", "fo")


@dataclass(frozen=True, kw_only=True)
class ObjElements:
    """What an OBJ file says, in its own order. The corners of its polygons lie one after the other."""

    verts: Float[np.ndarray, "vert 3"]
    vert_colors: Float[np.ndarray, "vert 3"] | None  # display (sRGB), 0..1; NaN: without
    uvs: Float[np.ndarray, "uv 2"]
    corner_vert: Int[np.ndarray, " corner"]
    corner_uv: Int[np.ndarray, " corner"]  # -1: without, for all corners of a polygon
    n_corners: Int[np.ndarray, " polygon"]  # three or more
    polygon_material: Int[np.ndarray, " polygon"]  # index into `material_names`, -1: none
    material_names: tuple[str, ...]
    libraries: tuple[str, ...]  # the rest of each mtllib line
    notes: tuple[str, ...]  # what was guessed or left out


class _Lines:
    """The lines of one file by their keyword."""

    def __init__(self, path: Path, text: str) -> None:
        self._path, self._lines = path, joined_lines(text)
        heads = [line[:2] for line in self._lines]
        if any(head[:1].isspace() for head in set(heads)):
            self._lines = [line.strip() for line in self._lines]
            heads = [line[:2] for line in self._lines]
        head_array = np.array(heads)

        def having(*wanted: str) -> Bool[np.ndarray, " line"]:
            return np.logical_or.reduce([head_array == head for head in wanted])

        self.v, self.vt, self.f = map(
            np.flatnonzero, (having("v ", "v\t"), having("vt"), having("f ", "f\t"))
        )
        numeric = having("", "v ", "v\t", "vt", "vn", "f ", "f\t")
        self._others = np.flatnonzero(~numeric)

    def others(self) -> Iterator[tuple[int, str, str]]:
        """Place, keyword and rest of the lines that are no list of numbers."""
        for place in self._others.tolist():
            keyword, *rest = self._lines[place].split(maxsplit=1)
            yield place, keyword, rest[0].strip() if rest else ""

    def blocks(
        self, places: Int[np.ndarray, " line"]
    ) -> Iterator[tuple[list[str], Int[np.ndarray, " line"]]]:
        for start in range(0, len(places), BLOCK_LINES):
            block = places[start : start + BLOCK_LINES]
            yield [self._lines[place] for place in block.tolist()], block

    def error(self, place: int, reason: object) -> ObjectError:
        return ObjectError(
            self._path,
            f"line {place + 1} cannot be read: {shown(self._lines[place].strip())} ({reason})",
            expected="'v x y z', 'vt u v' or 'f a/b/c ...' with indices that exist",
            action="Export the mesh again, for instance with Blender.",
        )

    def beginning(self) -> str:
        return next((line.strip() for line in self._lines if line.strip()), "")


def read_elements(path: Path, text: str) -> ObjElements:
    """Vertices, polygons and material names of an OBJ file. ObjectError names the line at fault.

    Polygons may come before their vertices. Corners that repeat the one before are dropped, and
    what is left with fewer than three.
    """
    lines = _Lines(path, text)
    columns = _numbers(lines, lines.v, "v", least=3, most=8)
    uvs = _numbers(lines, lines.vt, "vt", least=1, most=2)
    uvs = np.pad(uvs, ((0, 0), (0, 2 - uvs.shape[1])), constant_values=0.0)
    statements = _Statements(lines)
    notes = list(statements.notes)
    if not np.isfinite(uvs[:, 0]).all():
        count = int((~np.isfinite(uvs[:, 0])).sum())
        notes.append(f"{count} texture coordinates are no finite numbers and count as 0")
    if len(columns) == 0 and len(lines.f) == 0:
        raise ObjectError(
            path,
            f"has no faces and no vertices (begins with {shown(lines.beginning())})",
            expected="an OBJ file with lines 'v x y z' and 'f a b c'",
            action="Check that the file is what its name says.",
        )
    colors, guesses = colors_behind_coordinates(columns[:, 3:])
    if colors is None and statements.polypaint:
        colors = polypaint(statements.polypaint, len(columns))
    corner_vert, corner_uv, n_corners, places = _polygons(lines, len(uvs))
    return ObjElements(
        verts=columns[:, :3],
        vert_colors=colors,
        uvs=np.where(np.isfinite(uvs), uvs, 0.0),
        corner_vert=corner_vert,
        corner_uv=corner_uv,
        n_corners=n_corners,
        polygon_material=statements.material_at(places),
        material_names=tuple(statements.material_ids),
        libraries=tuple(statements.libraries),
        notes=(*notes, *guesses),
    )


class _Statements:
    """The lines that are no numbers: materials, their libraries, colours in comments."""

    def __init__(self, lines: _Lines) -> None:
        self.material_ids: dict[str, int] = {}
        self.libraries: list[str] = []
        self.polypaint: list[str] = []
        self._changes: list[tuple[int, int]] = []  # place of a usemtl line, material from there on
        left_out: Counter[str] = Counter()
        for place, keyword, rest in lines.others():
            keyword = keyword.lower()
            if keyword == "usemtl":
                material = self.material_ids.setdefault(rest, len(self.material_ids)) if rest else -1
                self._changes.append((place, material))
            elif keyword == "mtllib":
                self.libraries.append(rest)
            elif keyword == "#mrgb":
                self.polypaint.append(rest)
            elif keyword in ("v", "vt"):
                raise lines.error(place, "no numbers")
            elif keyword in LEFT_OUT:
                left_out[keyword] += 1
        listed = ", ".join(f"{count} x '{keyword}'" for keyword, count in left_out.items())
        self.notes = (f"left out: {listed} (only 'f' is read)",) if listed else ()

    def material_at(self, places: Int[np.ndarray, " polygon"]) -> Int[np.ndarray, " polygon"]:
        """The material that holds at these places, -1 before the first usemtl."""
        starts = np.array([place for place, _ in self._changes], dtype=np.int64)
        materials = np.array([-1, *(material for _, material in self._changes)], dtype=np.int64)
        return materials[np.searchsorted(starts, places)]


def _numbers(
    lines: _Lines, places: Int[np.ndarray, " row"], keyword: str, *, least: int, most: int
) -> Float[np.ndarray, "row column"]:
    """The numbers behind a keyword, at least and at most so many in a row; NaN where it is shorter."""
    tables = [np.zeros((0, least))]
    for texts, block in lines.blocks(places):
        table = _uniform_numbers(texts, keyword, least, most)
        if table is None:
            table = _uneven_numbers(lines, texts, block, keyword, least, most)
        tables.append(table)
    width = max(table.shape[1] for table in tables)
    return np.concatenate(
        [np.pad(table, ((0, 0), (0, width - table.shape[1])), constant_values=np.nan) for table in tables]
    )


def _uniform_numbers(
    texts: list[str], keyword: str, least: int, most: int
) -> Float[np.ndarray, "row column"] | None:
    """All lines at once; None where they differ in length or hold anything but numbers."""
    joined = " ".join(texts)
    words, width = joined.split(), len(texts[0].split())
    uniform = len(words) == width * len(texts) and words[::width].count(keyword) == len(texts)
    if not uniform or width - 1 < least or "_" in joined:
        return None
    del words[::width]
    try:
        flat = np.fromiter(map(float, words), dtype=np.float64, count=len(words))
    except ValueError:
        return None
    return flat.reshape(len(texts), width - 1)[:, :most]


def _uneven_numbers(
    lines: _Lines, texts: list[str], places: Int[np.ndarray, " row"], keyword: str, least: int, most: int
) -> Float[np.ndarray, "row column"]:
    table = np.full((len(texts), most), np.nan)
    for row, text, place in zip(table, texts, places.tolist()):
        try:
            words = without_comment(text).split()
            if words[0] != keyword:
                raise ValueError(f"{shown(words[0])} is no keyword")
            if len(words) <= least:
                raise ValueError(f"fewer than {least} numbers")
            row[: len(words) - 1] = [number(word) for word in words[1 : most + 1]]
        except ValueError as error:
            raise lines.error(place, error) from error
    return table


def _polygons(
    lines: _Lines, n_uvs: int
) -> tuple[
    Int[np.ndarray, " corner"],
    Int[np.ndarray, " corner"],
    Int[np.ndarray, " polygon"],
    Int[np.ndarray, " polygon"],
]:
    """Vertex and UV of each corner, corners of each polygon, and the place of each polygon's line."""
    corners, sizes = [np.zeros((0, 2), dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for texts, block in lines.blocks(lines.f):
        read = _uniform_corners(texts) or _mixed_corners(lines, texts, block)
        corners.append(read[0])
        sizes.append(read[1])
    written, size = np.concatenate(corners), np.concatenate(sizes)
    place = np.repeat(lines.f, size)
    verts = _indices(lines, written[:, 0], place, lines.v)
    if (written[:, 0] == 0).any():
        raise lines.error(int(place[np.argmax(written[:, 0] == 0)]), "indices count from 1")
    uvs = _indices(lines, written[:, 1], place, lines.vt) if n_uvs else np.full(len(verts), -1)
    return _cleaned(verts, uvs, size, lines.f)


def _uniform_corners(
    texts: list[str],
) -> tuple[Int[np.ndarray, "corner 2"], Int[np.ndarray, " polygon"]] | None:
    """Vertex and UV index as written (0: none) and the sizes; None where corners differ in kind."""
    words = " ".join(texts).split()
    width = len(texts[0].split())
    if len(words) == width * len(texts) and words[::width].count("f") == len(texts):
        sizes = np.full(len(texts), width - 1)
        del words[::width]
    else:
        starts = [k for k, word in enumerate(words) if word == "f"]
        sizes = np.diff([*starts, len(words)]) - 1
        words = [word for word in words if word != "f"]
    slashes = {word.count("/") for word in words}
    if len(sizes) != len(texts) or len(slashes) != 1 or max(slashes) > 2:
        return None
    fields = slashes.pop() + 1
    text = " ".join(words).replace("//", "/0/").replace("/", " ")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # NumPy's way to say that a word is no number
            indices = np.fromstring(text, dtype=np.int64, sep=" ")
    except (ValueError, DeprecationWarning):
        return None
    if len(indices) != fields * len(words):
        return None
    table = indices.reshape(-1, fields)
    return (table[:, :2] if fields > 1 else np.pad(table, ((0, 0), (0, 1)))), sizes


def _mixed_corners(
    lines: _Lines, texts: list[str], places: Int[np.ndarray, " polygon"]
) -> tuple[Int[np.ndarray, "corner 2"], Int[np.ndarray, " polygon"]]:
    corners, sizes = [], []
    for text, place in zip(texts, places.tolist()):
        words = without_comment(text).split()[1:]
        try:
            corners += [_corner(word) for word in words]
        except ValueError as error:
            raise lines.error(place, error) from error
        sizes.append(len(words))
    return np.array(corners, dtype=np.int64).reshape(-1, 2), np.array(sizes, dtype=np.int64)


def _corner(word: str) -> tuple[int, int]:
    """a, a/b, a//c or a/b/c: vertex and UV index, 0 for no UV."""
    match = CORNER.fullmatch(word)
    if match is None:
        raise ValueError(f"{shown(word)} is no corner")
    return int(match[1]), int(match[2] or 0)


def _indices(
    lines: _Lines,
    written: Int[np.ndarray, " corner"],
    place: Int[np.ndarray, " corner"],
    defined: Int[np.ndarray, " element"],
) -> Int[np.ndarray, " corner"]:
    """From 0 on; -1 for 0. OBJ counts from 1, and negative ones back from the latest element."""
    before = np.searchsorted(defined, place) if (written < 0).any() else 0
    indices = np.where(written < 0, written + before, written - 1)
    bad = (written != 0) & ((indices < 0) | (indices >= len(defined)))
    if bad.any():
        first = np.argmax(bad)
        raise lines.error(int(place[first]), f"index {written[first]} of {len(defined)}")
    return indices


def _cleaned(
    verts: Int[np.ndarray, " corner"],
    uvs: Int[np.ndarray, " corner"],
    size: Int[np.ndarray, " polygon"],
    places: Int[np.ndarray, " polygon"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Without corners that repeat the one before, and without what is no polygon then."""
    polygon = np.repeat(np.arange(len(size)), size)
    partly = np.bincount(polygon[uvs < 0], minlength=len(size)) > 0
    uvs = np.where(partly[polygon], -1, uvs)
    previous = np.roll(verts, 1)
    filled = size > 0
    ends = np.cumsum(size)[filled]
    previous[ends - size[filled]] = verts[ends - 1]
    kept = verts != previous
    size = np.bincount(polygon[kept], minlength=len(size))
    kept &= (size >= 3)[polygon]
    drawn = size >= 3
    return verts[kept], uvs[kept], size[drawn], places[drawn]
