"""PLY meshes: polygons and triangle strips, colours, and the textures that comments name."""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.objects.errors import ObjectError
from datagen.objects.files.named_files import NamedFiles, spellings
from datagen.objects.formats.plain_material import PLAIN, WHITE
from datagen.objects.formats.ply_file import PlyElement, PlyHeader, read_body, read_header
from datagen.objects.mesh.file_mesh import FileMesh
from datagen.objects.mesh.object_mesh import Material
from datagen.objects.mesh.polygons import triangulated
from shards.color import linear_from_srgb

__all__ = ["read_ply"]

INDEX_NAMES = ("vertex_indices", "vertex_index")
COLOR_NAMES = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
ALPHA_NAMES = ("alpha", "a", "diffuse_alpha")
UV_NAMES = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
TEXTURE_COMMENT = re.compile(r"texture_?file[\s:=]+(.*\S)", re.IGNORECASE)
KNOWN_ELEMENTS = {"vertex", "face", "tristrips", "edge", "camera"}  # others are noted
NO_ELEMENT = PlyElement(count=0)
BYTE_FULL, SHORT_FULL = 255.0, 65535.0
LARGEST_FLOAT = 2.0  # floats beyond it do not count to 1


@dataclass(frozen=True, kw_only=True)
class _Ply:
    """One file as it is stored, and what its reader has to say."""

    path: Path
    header: PlyHeader
    elements: dict[str, PlyElement]
    notes: list[str] = field(default_factory=list)

    def element(self, name: str) -> PlyElement:
        return self.elements.get(name, NO_ELEMENT)

    def refused(self, problem: str, expected: str) -> ObjectError:
        return ObjectError(
            self.path,
            problem,
            expected=expected,
            action="Export the mesh again, for instance with Blender.",
        )


@dataclass(frozen=True, kw_only=True)
class _Polygons:
    """Faces of any length, one after the other."""

    corners: Int[np.ndarray, " corner"]  # indices of vertices that exist
    lengths: Int[np.ndarray, " polygon"]
    element: PlyElement  # whose rows the polygons are; of strips one without properties


@dataclass(frozen=True, kw_only=True)
class _Placed:
    """Texture coordinates, from the lower left of the image."""

    uv: Float[np.ndarray, "corner 2"]
    absent: Bool[np.ndarray, " polygon"]


@dataclass(frozen=True, kw_only=True)
class _Textured:
    """What texture each polygon shows, and where."""

    uv: Float[np.ndarray, "corner 2"]
    material: Int[np.ndarray, " polygon"]
    materials: tuple[Material, ...]


def read_ply(path: Path, data: bytes, *, max_file_mb: float) -> FileMesh:
    """The mesh of a PLY file. ObjectError also where it holds none: points, gaussian splats, curves."""
    header = read_header(data, path)
    _refuse_other_than_meshes(header, path)
    ply = _Ply(path=path, header=header, elements=read_body(data, header, path))
    ply.notes.extend(
        f"the PLY element {name!r} is not read"
        for name, element in ply.elements.items()
        if element.count and name not in KNOWN_ELEMENTS
    )
    verts = _positions(ply)
    polygons = _polygons(ply, len(verts))
    triangle_corners, polygon_of_face = triangulated(verts, polygons.corners, polygons.lengths)
    faces = polygons.corners[triangle_corners]
    colors = _corner_colors(ply, faces, polygon_of_face)
    textured = _textured(ply, polygons, max_file_mb, has_colors=colors is not None)
    if textured is not None:
        if colors is not None and (colors < 1).any():
            ply.notes.append("has a texture and colours; drawn with the texture alone")
        return FileMesh(
            verts_file=verts,
            faces=faces,
            corner_uv=textured.uv[triangle_corners],
            face_material=textured.material[polygon_of_face],
            materials=textured.materials,
            corner_colors=None,
            notes=tuple(ply.notes),
        )
    return FileMesh(
        verts_file=verts,
        faces=faces,
        corner_uv=np.zeros((len(faces), 3, 2)),
        face_material=np.zeros(len(faces), dtype=np.int64),
        materials=(PLAIN if colors is None else WHITE,),
        corner_colors=colors,
        notes=tuple(ply.notes),
    )


def _refuse_other_than_meshes(header: PlyHeader, path: Path) -> None:
    """By the header alone: what is no mesh may be large."""
    if header.count("face") or header.count("tristrips"):
        return
    names = header.types("vertex").keys()
    if "packed_position" in names or {"opacity", "scale_0", "rot_0"} <= names:
        kind = "is a gaussian splat, not a mesh"
        action = "Extract a mesh from it with the program that made it."
    elif header.count("vertex") and not header.count("edge"):
        kind = "is a point cloud, not a mesh"
        action = "Mesh the points first, for instance by Poisson reconstruction in MeshLab."
    else:
        kind, action = "is not a mesh", "Export a surface; edges alone enclose nothing."
    raise ObjectError(
        path,
        f"{kind}: it has no faces ({header.count('vertex'):,} vertices)",
        expected="a triangle mesh",
        action=action,
    )


def _positions(ply: _Ply) -> Float[np.ndarray, "vert 3"]:
    numbers = ply.element("vertex").numbers
    if not {"x", "y", "z"} <= numbers.keys():
        raise ply.refused("has no vertices with x, y and z", "an element 'vertex' with these properties")
    types = ply.header.types("vertex")  # a text is as precise as bytes of its types would be
    return np.stack([numbers[axis].astype(types[axis]) for axis in "xyz"], axis=1).astype(np.float64)


def _polygons(ply: _Ply, n_verts: int) -> _Polygons:
    element = ply.element("face")
    if not element.count:
        return _strips(ply, n_verts)
    found = next((element.lists[name] for name in INDEX_NAMES if name in element.lists), None)
    if found is None and len(element.lists) == 1:
        found = next(iter(element.lists.values()))
    if found is None:
        raise ply.refused("has faces without vertex indices", f"a list called {' or '.join(INDEX_NAMES)}")
    return _Polygons(corners=_indices(ply, found.values, n_verts), lengths=found.lengths, element=element)


def _strips(ply: _Ply, n_verts: int) -> _Polygons:
    """Each corner makes a triangle with the two before it, every other one turned over; -1 starts anew."""
    lists = list(ply.element("tristrips").lists.values())
    if len(lists) != 1:
        raise ply.refused("has triangle strips without vertex indices", "one list of them per strip")
    values = lists[0].values.astype(np.float64)
    values[values == 2**32 - 1] = -1.0  # as unsigned int
    flat = np.insert(values, np.cumsum(lists[0].lengths), -1.0)  # rows are strips of their own
    is_break = flat == -1.0
    place = np.arange(len(flat))
    behind_break = place - np.maximum.accumulate(np.where(is_break, place, -1))
    whole = ~(is_break[:-2] | is_break[1:-1] | is_break[2:])
    turned = behind_break[:-2] % 2 == 0  # a strip's first corner stands 1 behind its break
    first, second, third = flat[:-2], flat[1:-1], flat[2:]
    triangles = np.stack([first, np.where(turned, third, second), np.where(turned, second, third)], axis=1)
    n_triangles = int(whole.sum())
    return _Polygons(
        corners=_indices(ply, triangles[whole].reshape(-1), n_verts),
        lengths=np.full(n_triangles, 3, dtype=np.int64),
        element=PlyElement(count=n_triangles),
    )


def _indices(ply: _Ply, values: np.ndarray, n_verts: int) -> Int[np.ndarray, " corner"]:
    whole = values.dtype.kind in "iu" or bool((values == np.floor(values)).all())
    if len(values) and not (whole and values.min() >= 0 and values.max() < n_verts):
        good = (values >= 0) & (values < n_verts) & (values == np.floor(values))
        raise ply.refused(
            f"a face names vertex {float(values[np.argmin(good)]):g} of {n_verts:,}",
            f"whole numbers from 0 to {n_verts - 1}",
        )
    return values.astype(np.int64)


def _corner_colors(
    ply: _Ply, faces: Int[np.ndarray, "face 3"], polygon_of_face: Int[np.ndarray, " face"]
) -> Float[np.ndarray, "face 3 rgb"] | None:
    """Linear colours of vertices or faces; where there are both, those that vary, vertices first."""
    by_vertex, by_polygon = _colors(ply, "vertex"), _colors(ply, "face")
    if by_vertex is not None and by_polygon is not None:
        takes_polygons = bool(np.ptp(by_polygon, axis=0).any() and not np.ptp(by_vertex, axis=0).any())
        by_vertex = None if takes_polygons else by_vertex
        taken = "faces" if takes_polygons else "vertices"
        ply.notes.append(f"has colours of vertices and of faces; those of the {taken} are drawn")
    if by_vertex is not None:
        return by_vertex[faces]
    return None if by_polygon is None else np.repeat(by_polygon[polygon_of_face][:, None], 3, axis=1)


def _colors(ply: _Ply, name: str) -> Float[np.ndarray, "row rgb"] | None:
    """Linear 0..1; PLY colours are display (sRGB) values by custom, whatever their type."""
    element = ply.element(name)
    names = next((names for names in COLOR_NAMES if set(names) <= element.numbers.keys()), None)
    if names is None:
        return None
    declared = ply.header.types(name)[names[0]]
    written = np.stack([element.numbers[channel].astype(np.float64) for channel in names], axis=1)
    if declared == np.int8:  # meant as bytes without a sign
        written %= BYTE_FULL + 1
    if not (np.isfinite(written) & (written >= 0) & (written <= SHORT_FULL)).all():
        raise ply.refused(f"a colour of a {name} is out of range", "0 to 1, to 255 or to 65535")
    largest = float(written.max())
    full, usual = _full_value(declared, largest)
    if full != usual:
        ply.notes.append(
            f"{name} colours of type {declared.name} reach {largest:g}: {full:g} was taken for full, not {usual:g}"
        )
    alpha = next((element.numbers[key] for key in ALPHA_NAMES if key in element.numbers), None)
    if alpha is not None and (alpha.astype(np.float64) % (BYTE_FULL + 1) < full).any() and alpha.any():
        ply.notes.append(f"{name} colours are partly transparent; drawn opaque")
    return linear_from_srgb(np.minimum(written / full, 1.0))


def _full_value(declared: np.dtype, largest: float) -> tuple[float, float]:
    """The value of full brightness: as the largest value tells, and as the type alone would."""
    by_range = BYTE_FULL if largest <= BYTE_FULL else SHORT_FULL
    if declared.kind == "f":
        return (1.0 if largest <= LARGEST_FLOAT else by_range), 1.0
    return by_range, SHORT_FULL if declared == np.uint16 else BYTE_FULL


def _textured(ply: _Ply, polygons: _Polygons, max_file_mb: float, *, has_colors: bool) -> _Textured | None:
    """None where the file names no texture, or has a note on why it is not drawn."""
    names = [match[1] for match in map(TEXTURE_COMMENT.match, ply.header.comments) if match]
    placed = _placed(ply, polygons) if names else None
    if not names:
        return None
    if placed is None:
        ply.notes.append(f"texture {names[0]!r} is not drawn: there are no texture coordinates")
        return None
    files = NamedFiles(ply.path, max_file_mb)
    images: list[Path] = []
    for name in names:
        found = files.find(spellings(name), (ply.path.parent,))
        if found is None and has_colors:
            ply.notes.append(f"texture {name!r} is missing; drawn with the colours instead")
            return None
        if found is None:
            raise ObjectError(
                ply.path,
                f"texture {name!r} is missing",
                expected=f"an image of that name in {ply.path.parent} or below",
                action="Put the image there or remove its 'comment TextureFile' from the file.",
            )
        images.append(found.path)
    materials = [replace(WHITE, name=image.name, base_color_image=files.read(image)) for image in images]
    number = polygons.element.numbers.get("texnumber", np.zeros(len(polygons.lengths)))
    bare = (number < 0) | (number >= len(materials)) | placed.absent
    material = np.where(bare, len(materials), number).astype(np.int64)
    return _Textured(
        uv=placed.uv, material=material, materials=(*materials, PLAIN) if bare.any() else tuple(materials)
    )


def _placed(ply: _Ply, polygons: _Polygons) -> _Placed | None:
    """From lists at the faces (MeshLab's wedges), else from the vertices."""
    wedges = polygons.element.lists.get("texcoord")
    numbers = ply.element("vertex").numbers
    names = next((names for names in UV_NAMES if set(names) <= numbers.keys()), None)
    if wedges is not None:
        has = wedges.lengths == 2 * polygons.lengths
        if not (has | (wedges.lengths == 0)).all():
            raise ply.refused(
                "a 'texcoord' list does not fit the corners of its face", "two numbers a corner"
            )
        uv = np.zeros((len(polygons.corners), 2))
        uv[np.repeat(has, polygons.lengths)] = wedges.values.reshape(-1, 2)
        placed = _Placed(uv=uv, absent=~has)
    elif names is not None:
        by_vertex = np.stack([numbers[name].astype(np.float64) for name in names], axis=1)
        placed = _Placed(uv=by_vertex[polygons.corners], absent=np.zeros(len(polygons.lengths), dtype=bool))
    else:
        return None
    if not np.isfinite(placed.uv).all():
        raise ply.refused("a texture coordinate is NaN or infinite", "finite numbers")
    return placed
