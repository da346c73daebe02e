"""Wavefront OBJ and MTL. Strict where trimesh guesses: every fault names the line."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from manifold3d import triangulate

from datagen.objects.errors import ObjectError
from datagen.objects.formats.mtl_material import MtlEntry, material_from_mtl
from datagen.objects.mesh.file_mesh import FileMesh
from datagen.objects.mesh.object_mesh import Material

__all__ = ["read_obj"]

GREY = MtlEntry(name="unnamed", kd=(0.6, 0.6, 0.6))


@dataclass
class _Reading:
    """Growing lists while the lines of one OBJ file are read."""

    path: Path
    ignore_missing_images: bool
    verts: list[tuple[float, ...]]
    colors: list[tuple[float, ...]]
    uvs: list[tuple[float, ...]]
    polygons: list[tuple[int, list[int], list[int]]]  # material, vertex indices, uv indices
    material_names: dict[str, int]
    libraries: list[str]


def read_obj(path: Path, *, ignore_missing_images: bool = False) -> FileMesh:
    """All faces of an OBJ file with the materials of its MTL files; polygons are triangulated.

    With `ignore_missing_images` a material whose image is absent keeps its plain colour; without,
    it is refused by name.
    """
    reading = _Reading(path, ignore_missing_images, [], [], [], [], {}, [])
    material = -1
    text = path.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ")
    for number, line in enumerate(text.splitlines(), start=1):
        keyword, _, rest = line.strip().partition(" ")
        if keyword == "usemtl":
            material = reading.material_names.setdefault(rest.strip(), len(reading.material_names))
        elif keyword == "mtllib":
            reading.libraries.append(rest.strip())
        elif keyword in ("v", "vt", "f"):
            try:
                _read_element(reading, keyword, rest.split(), material)
            except (ValueError, IndexError) as error:
                raise ObjectError(
                    path,
                    f"line {number} cannot be read: {line.strip()[:60]!r} ({error})",
                    expected="'v x y z', 'vt u v' or 'f a/b/c ...' with indices that exist",
                    action="Export the mesh again, for instance with Blender.",
                ) from error
    return _assemble(reading)


def _read_element(reading: _Reading, keyword: str, words: list[str], material: int) -> None:
    if keyword == "v":
        values = tuple(float(word) for word in words)
        if len(values) < 3:
            raise ValueError("fewer than three coordinates")
        reading.verts.append(values[:3])
        reading.colors.append(values[3:6] if len(values) in (6, 7) else ())
    elif keyword == "vt":
        reading.uvs.append((float(words[0]), float(words[1]) if len(words) > 1 else 0.0))
    else:
        corners = [word.split("/") for word in words]
        verts = [_index(corner[0], len(reading.verts)) for corner in corners]
        has_uv = all(len(corner) > 1 and corner[1] for corner in corners)
        uvs = [_index(corner[1], len(reading.uvs)) for corner in corners] if has_uv else []
        if len(verts) >= 3:  # two corners draw nothing
            reading.polygons.append((material, verts, uvs))


def _index(word: str, count: int) -> int:
    """OBJ counts from 1; negative indices count back from the latest element."""
    value = int(word)
    index = value - 1 if value > 0 else count + value
    if value == 0 or not 0 <= index < count:
        raise IndexError(f"index {value} of {count}")
    return index


def _triangles(corners: Float[np.ndarray, "corner 3"]) -> list[tuple[int, int, int]]:
    """Triangulation of one planar polygon, concave ones too; its winding is kept."""
    count = len(corners)
    if count == 3:
        return [(0, 1, 2)]
    following = np.roll(corners, -1, axis=0)
    normal = np.cross(corners, following).sum(axis=0)  # Newell: right for concave polygons too
    length = np.linalg.norm(normal)
    fan = [(0, k, k + 1) for k in range(1, count - 1)]
    if length < 1e-20:
        return fan
    turns = np.cross(corners - np.roll(corners, 1, axis=0), following - corners) @ normal
    if (turns >= -1e-9 * length * length).all():
        return fan
    axis_u = np.eye(3)[np.argmin(np.abs(normal))]
    axis_u = np.cross(normal, axis_u) / np.linalg.norm(np.cross(normal, axis_u))
    axis_v = np.cross(normal / length, axis_u)
    flat = np.stack([corners @ axis_u, corners @ axis_v], axis=1)
    triangles = [(int(a), int(b), int(c)) for a, b, c in triangulate([flat])]
    return triangles or fan


def _assemble(reading: _Reading) -> FileMesh:
    verts = np.array(reading.verts, dtype=np.float64).reshape(-1, 3)
    uv_table = np.array([*reading.uvs, (0.0, 0.0)], dtype=np.float64).reshape(-1, 2)
    faces: list[list[int]] = []
    face_uvs: list[list[int]] = []
    face_material: list[int] = []
    for material, corner_verts, corner_uvs in reading.polygons:
        uvs = corner_uvs or [len(reading.uvs)] * len(corner_verts)
        for triangle in _triangles(verts[corner_verts]):
            faces.append([corner_verts[k] for k in triangle])
            face_uvs.append([uvs[k] for k in triangle])
            face_material.append(material)
    entries = _read_libraries(reading)
    materials = [_material(reading, entries, name) for name in reading.material_names]
    material_ids = np.array(face_material, dtype=np.int64)
    if (material_ids < 0).any():
        material_ids[material_ids < 0] = len(materials)
        materials.append(material_from_mtl(GREY, {}))
    face_array = np.array(faces, dtype=np.int64).reshape(-1, 3)
    has_colors = bool(reading.colors) and all(len(color) == 3 for color in reading.colors)
    return FileMesh(
        verts_file=verts,
        faces=face_array,
        corner_uv=uv_table[np.array(face_uvs, dtype=np.int64).reshape(-1, 3)],
        face_material=material_ids,
        materials=tuple(materials),
        corner_colors=np.array(reading.colors)[face_array] if has_colors else None,
    )


def _material(reading: _Reading, entries: dict[str, MtlEntry], name: str) -> Material:
    entry = entries.get(name)
    if entry is None:
        if reading.libraries:
            raise ObjectError(
                reading.path,
                f"material {name!r} is in none of {reading.libraries}",
                expected="every usemtl name in an MTL file",
                action="Add the material to the MTL file or remove the usemtl line.",
            )
        entry = MtlEntry(name=name, kd=GREY.kd)
    images = {key: _image_bytes(reading, value) for key, value in entry.maps.items()}
    return material_from_mtl(entry, {key: image for key, image in images.items() if image is not None})


def _image_bytes(reading: _Reading, name: str) -> bytes | None:
    path = reading.path.parent / name.replace("\\", "/")
    if not path.is_file():
        if reading.ignore_missing_images:
            return None
        raise ObjectError(
            reading.path,
            f"texture {name!r} is missing",
            expected=f"an image at {path}",
            action="Put the image there or remove its map_ line from the MTL file.",
        )
    return path.read_bytes()


def _read_libraries(reading: _Reading) -> dict[str, MtlEntry]:
    entries: dict[str, MtlEntry] = {}
    for name in reading.libraries:
        path = reading.path.parent / name
        if not path.is_file():
            raise ObjectError(
                reading.path,
                f"material library {name!r} is missing",
                expected=f"a file at {path}",
                action="Put the MTL file there or remove the mtllib line.",
            )
        entries.update(_read_mtl(path))
    return entries


def _read_mtl(path: Path) -> dict[str, MtlEntry]:
    """newmtl blocks; keywords that change nothing here are passed over."""
    blocks: dict[str, dict[str, list[str]]] = {}
    block: dict[str, list[str]] = {}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        words = line.split("#")[0].split()
        if not words:
            continue
        if words[0] == "newmtl":
            block = blocks.setdefault(" ".join(words[1:]), {})
        else:
            block[words[0].lower()] = words[1:]
    try:
        return {name: MtlEntry.from_words(name, words) for name, words in blocks.items()}
    except (ValueError, IndexError) as error:
        raise ObjectError(
            path,
            f"a number cannot be read ({error})",
            expected="numbers after Kd, Ks, Ke, Ns, d, Tr, Ni, Pr and Pm",
            action="Export the materials again, for instance with Blender.",
        ) from error
