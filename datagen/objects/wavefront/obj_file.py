"""Wavefront OBJ to a FileMesh. Every fault names the line, every guess is a note."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.objects.files.decoded_text import decoded_text
from datagen.objects.files.named_files import NamedFiles
from datagen.objects.mesh.file_mesh import FileMesh
from datagen.objects.mesh.polygons import triangulated
from datagen.objects.wavefront.lines import shown
from datagen.objects.wavefront.mtl_libraries import MtlLibraries
from datagen.objects.wavefront.obj_elements import ObjElements, read_elements
from datagen.objects.wavefront.obj_materials import ObjMaterial, ObjMaterials
from shards.color import linear_from_srgb

__all__ = ["read_obj"]

MAX_NOTES = 20


def read_obj(path: Path, *, max_file_mb: float, ignore_missing_images: bool = False) -> FileMesh:
    """All faces of an OBJ file with the materials of its MTL files; polygons are triangulated.

    The OBJ, each MTL and each image may have `max_file_mb` (10^6 bytes), and must lie in the OBJ's
    folder or below. With `ignore_missing_images` a material whose image is absent keeps its plain
    colour; without, it is refused by name.
    """
    files = NamedFiles(path, max_file_mb)
    elements = read_elements(path, decoded_text(path, files.read(path)))
    corners, polygon = triangulated(elements.verts, elements.corner_vert, elements.n_corners)
    faces = elements.corner_vert[corners]
    colors = _corner_colors(elements, faces)
    colored = np.zeros(len(faces), dtype=bool) if colors is None else np.isfinite(colors).any(axis=(1, 2))
    statement = elements.polygon_material[polygon]
    libraries = MtlLibraries(path, files, elements.libraries if elements.material_names else ())
    maker = ObjMaterials(path, files, libraries, ignore_missing_images=ignore_missing_images)
    looks, face_material = _looks(maker, elements.material_names, statement, colored)
    notes = [*elements.notes, *maker.notes]
    if elements.libraries and not elements.material_names:
        notes.append(f"no usemtl line: material library {shown(elements.libraries[0])} is not used")
    textured = np.array([look.material.base_color_image is not None for look in looks], dtype=bool)
    if colors is not None:
        colors = _factors(colors, looks, textured, face_material, notes)
    uv_indices = elements.corner_uv[corners]
    unplaced = int((textured[face_material] & (uv_indices < 0).any(axis=1)).sum())
    if unplaced:
        notes.append(f"{unplaced} textured faces have no texture coordinates and show one texel")
    return FileMesh(
        verts_file=elements.verts,
        faces=faces,
        corner_uv=_placed_uv(elements.uvs, uv_indices, looks, face_material),
        face_material=face_material,
        materials=tuple(look.material for look in looks),
        corner_colors=colors,
        notes=tuple(notes[:MAX_NOTES])
        + ((f"and {len(notes) - MAX_NOTES} more notes",) if len(notes) > MAX_NOTES else ()),
    )


def _looks(
    maker: ObjMaterials,
    names: tuple[str, ...],
    statement: Int[np.ndarray, " face"],
    colored: Bool[np.ndarray, " face"],
) -> tuple[list[ObjMaterial], Int[np.ndarray, " face"]]:
    """The materials that faces use, in the order of their names, and the index of each face's."""
    used = np.unique(statement[statement >= 0])
    with_color = set(np.unique(statement[colored]).tolist())
    looks = [maker.named(names[index], is_colored=index in with_color) for index in used.tolist()]
    if (statement < 0).any():
        looks.append(maker.unnamed(is_colored=-1 in with_color))
    return looks, np.where(statement < 0, len(used), np.searchsorted(used, statement))


def _corner_colors(
    elements: ObjElements, faces: Int[np.ndarray, "face 3"]
) -> Float[np.ndarray, "face 3 rgb"] | None:
    """Linear vertex colours, NaN where a vertex has none."""
    if elements.vert_colors is None:
        return None
    missing = np.isnan(elements.vert_colors)
    return np.where(missing, np.nan, linear_from_srgb(np.where(missing, 0.0, elements.vert_colors)))[faces]


def _factors(
    colors: Float[np.ndarray, "face 3 rgb"],
    looks: list[ObjMaterial],
    textured: Bool[np.ndarray, " material"],
    face_material: Int[np.ndarray, " face"],
    notes: list[str],
) -> Float[np.ndarray, "face 3 rgb"]:
    """What vertex colours multiply; 1 on textured faces, whose image holds the colour already.

    Photogrammetry writes the same colour twice, into the image and at the vertices.
    """
    plain = linear_from_srgb(np.array([look.plain_rgb for look in looks]))[face_material]
    factors = np.where(np.isnan(colors), plain[:, None], colors)
    on_image = textured[face_material]
    dropped = int((factors[on_image] != 1.0).any(axis=(1, 2)).sum())
    if dropped:
        notes.append(f"vertex colours of {dropped} textured faces are left out; their image tells the colour")
    factors[on_image] = 1.0
    return factors


def _placed_uv(
    uvs: Float[np.ndarray, "uv 2"],
    uv_indices: Int[np.ndarray, "face 3"],
    looks: list[ObjMaterial],
    face_material: Int[np.ndarray, " face"],
) -> Float[np.ndarray, "face 3 2"]:
    """Where each corner looks up the images of its material; (0, 0) where it has no coordinates."""
    table = np.concatenate([uvs, np.zeros((1, 2))])  # index -1
    placed = table[uv_indices]
    for index, look in enumerate(looks):
        own = face_material == index
        if look.scale != (1.0, 1.0) or look.offset != (0.0, 0.0):
            placed[own] = placed[own] * look.scale + look.offset
    return placed
