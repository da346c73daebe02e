"""STL meshes: text in any dialect, bytes with or without colours, several solids in one file."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from datagen.objects.errors import ObjectError
from datagen.objects.formats.number_text import numbers_of
from datagen.objects.formats.plain_material import PLAIN, WHITE
from datagen.objects.mesh.file_mesh import FileMesh
from shards.color import linear_from_srgb

__all__ = ["read_stl"]

HEADER_BYTES = 84  # 80 of any content, then the count
FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
COUNT_LATER = (0, 2**32 - 1)  # of writers that do not know it when they begin
LOOP_MARK = 2.0**1023  # stands for "outer loop" among the numbers of a text
MAGICS = re.compile(rb"COLOR=(....)", re.DOTALL)


@dataclass(frozen=True, kw_only=True)
class _Facets:
    corners: Float[np.ndarray, "face 3 xyz"]
    colors: Float[np.ndarray, "face rgb"] | None  # linear
    notes: tuple[str, ...]


def read_stl(path: Path, data: bytes) -> FileMesh:
    """The triangles of an STL file, of all its solids together. ObjectError where it is not whole."""
    facets = _text_facets(path, _as_bytes(data)) if _is_text(data) else _binary_facets(path, data)
    n_faces = len(facets.corners)
    return FileMesh(
        verts_file=facets.corners.reshape(-1, 3),
        faces=np.arange(3 * n_faces).reshape(-1, 3),
        corner_uv=np.zeros((n_faces, 3, 2)),
        face_material=np.zeros(n_faces, dtype=np.int64),
        materials=(PLAIN if facets.colors is None else WHITE,),
        corner_colors=None if facets.colors is None else np.repeat(facets.colors[:, None], 3, axis=1),
        notes=facets.notes,
    )


def _is_text(data: bytes) -> bool:
    """Bytes may begin with "solid" too; but what has the length of its counts is bytes, and text holds no 0."""
    return not _solid_ends(data) and b"\0" not in _as_bytes(data)


def _as_bytes(data: bytes) -> bytes:
    """The text without byte order mark and padding; UTF-16 becomes UTF-8."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", errors="replace").encode()
    return data.removeprefix(b"\xef\xbb\xbf").rstrip(b"\0\x1a")


def _count(data: bytes, at: int) -> int:
    """Triangles of the solid whose header begins at byte `at`, as it states."""
    return int.from_bytes(data[at + HEADER_BYTES - 4 : at + HEADER_BYTES], "little")


def _solid_ends(data: bytes) -> list[int]:
    """Where solids of bytes end, the last of them with the file; none where counts and length disagree."""
    ends, at = [], 0
    while len(data) - at >= HEADER_BYTES and _count(data, at):
        at += HEADER_BYTES + _count(data, at) * FACET.itemsize
        ends.append(at)
    return ends if at == len(data) else []


def _text_facets(path: Path, data: bytes) -> _Facets:
    """What stands between "outer loop" and "endloop"; normals are not read, so they may be anything."""
    text = data.lower()
    loops: list[bytes] = []
    for piece in text.split(b"outer")[1:]:  # a solid's name may hold the word too
        inside = piece.lstrip()
        if not inside.startswith(b"loop"):
            continue
        end = inside.find(b"endloop")
        if end < 0:
            raise _cut_short(path, f"triangle {len(loops) + 1:,} has no 'endloop'")
        loops.append(inside[:end])
    if not loops:
        raise _empty(path, "no 'outer loop' in its text")
    mark = b" %.17e " % LOOP_MARK
    words = b"".join(loops).replace(b"loop", mark).replace(b"vertex", b" ")
    rows = numbers_of(words, path, "its coordinates")
    marks = np.flatnonzero(rows == LOOP_MARK)
    lengths = np.diff(marks, append=len(rows)) - 1
    if (lengths != 9).any():
        at = int(np.argmax(lengths != 9))
        raise ObjectError(
            path,
            f"triangle {at + 1:,} has {lengths[at]} coordinates",
            expected="three vertices of three coordinates each",
            action="Export the mesh again, for instance with Blender.",
        )
    open_end = text.rfind(b"endsolid") < text.rfind(b"endloop")
    notes = ("has no 'endsolid' at its end, so it may have been cut short",) if open_end else ()
    return _Facets(corners=rows.reshape(-1, 10)[:, 1:].reshape(-1, 3, 3), colors=None, notes=notes)


def _binary_facets(path: Path, data: bytes) -> _Facets:
    if len(data) < HEADER_BYTES:
        raise _cut_short(path, f"{len(data)} bytes are less than the header of an STL")
    ends = _solid_ends(data)
    notes: tuple[str, ...] = ()
    if not ends:
        present, notes = _present(path, data)
        ends = [HEADER_BYTES + present * FACET.itemsize]
    corners, colors = [], []
    for start, end in zip([0, *ends], ends):
        count = (end - start - HEADER_BYTES) // FACET.itemsize
        facets = np.frombuffer(data, FACET, count, start + HEADER_BYTES)
        corners.append(facets["corners"].astype(np.float64))
        colors.append(_colors(data[start : start + HEADER_BYTES], facets["attribute"]))
    if all(color is None for color in colors):
        return _Facets(corners=np.concatenate(corners), colors=None, notes=notes)
    plain = np.array(PLAIN.base_color_rgba[:3])
    filled = [np.tile(plain, (len(c), 1)) if color is None else color for c, color in zip(corners, colors)]
    return _Facets(corners=np.concatenate(corners), colors=np.concatenate(filled), notes=notes)


def _present(path: Path, data: bytes) -> tuple[int, tuple[str, ...]]:
    """Triangles of a single solid whose count and length disagree, and a note on what was taken."""
    stated = _count(data, 0)
    held, rest = divmod(len(data) - HEADER_BYTES, FACET.itemsize)
    if not stated and not held:
        raise _empty(path, "its header states 0")
    if not held or (held < stated and stated not in COUNT_LATER):
        raise _cut_short(path, f"its header states {stated:,} triangles, and {held:,} follow")
    if stated in COUNT_LATER or not rest:
        note = f"its header states {stated:,} triangles, and {held:,} follow: all were read"
        return held, (note + (f" but the last {rest} bytes" if rest else ""),)
    unread = len(data) - HEADER_BYTES - stated * FACET.itemsize
    return stated, (f"{unread:,} bytes after the last triangle were not read",)


def _colors(header: bytes, attribute: np.ndarray) -> Float[np.ndarray, "face rgb"] | None:
    """Linear colours from the two spare bytes of each triangle; None where no program put any there.

    Magics writes the colour of the object into the header, and of triangles with bit 15 clear
    (red lowest). VisCAM and SolidView write those with bit 15 set (red highest). MeshLab writes
    Magics files with the bit set everywhere: their colours are told by their being different.
    """
    flagged = (attribute & 0x8000) != 0
    magics = MAGICS.search(header)
    if magics is None and not flagged.any():
        return None
    channels = np.stack([attribute >> shift & 31 for shift in (0, 5, 10)], axis=1) / 31.0
    if magics is None:
        plain = np.array(PLAIN.base_color_rgba[:3])
        return np.where(flagged[:, None], linear_from_srgb(channels[:, ::-1]), plain)
    own = flagged if flagged.all() and np.ptp(attribute) else ~flagged
    if not attribute.any():  # nothing was written, rather than black
        own = flagged
    of_object = np.frombuffer(magics[1], dtype=np.uint8)[:3] / 255.0
    return linear_from_srgb(np.where(own[:, None], channels, of_object))


def _empty(path: Path, found: str) -> ObjectError:
    return ObjectError(
        path,
        f"holds no triangles ({found})",
        expected="an STL mesh",
        action="Export the mesh again; an empty selection is a common cause.",
    )


def _cut_short(path: Path, problem: str) -> ObjectError:
    return ObjectError(
        path,
        f"is cut short or damaged: {problem}",
        expected="a whole STL file",
        action="Copy the file again, or export the mesh again.",
    )
