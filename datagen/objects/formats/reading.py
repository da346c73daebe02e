"""Any mesh file to an ObjectMesh in the object frame: axes, unit, centre, refusals."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float

from datagen.objects.errors import ObjectError
from datagen.objects.files.texture_images import permitted_image
from datagen.objects.formats.ply import read_ply
from datagen.objects.formats.stl import read_stl
from datagen.objects.formats.units import METRES_PER, Unit, unit_of_size
from datagen.objects.gltf.container import MAX_FILE_MB
from datagen.objects.gltf.scene import read_gltf
from datagen.objects.mesh.file_mesh import FileMesh, refuse_too_many_faces
from datagen.objects.mesh.object_mesh import Material, ObjectMesh
from datagen.objects.wavefront.obj_file import read_obj
from shards.settings import Range

__all__ = ["MESH_SUFFIXES", "ReadObject", "ReadingConfig", "object_mesh", "read_object"]

MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
# glTF is Y-up in metres by its specification; the others say nothing.
GLTF_SUFFIXES = (".glb", ".gltf")
ROTATION_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True, kw_only=True)
class ReadingConfig:
    """How files that do not state unit and axes are read, and what is too much."""

    unit: Literal["m", "cm", "mm", "auto"]  # of OBJ, PLY and STL; glTF is always metres
    up_axis: Literal["y", "z"]  # of OBJ, PLY and STL; glTF is always Y-up
    max_faces: Annotated[int, Range(1, 1_000_000_000)]  # more are refused
    max_image_px: Annotated[int, Range(1, 65_536)]  # longer image sides are refused
    max_file_mb: Annotated[float, Range(0.001, 100_000)] = (
        MAX_FILE_MB  # 10^6 bytes; larger files are refused before they are read
    )


@dataclass(frozen=True, kw_only=True)
class ReadObject:
    """A mesh in the object frame and how it got there: x_obj = T_obj_from_file @ x_file."""

    mesh: ObjectMesh
    T_obj_from_file: Float[np.ndarray, "4 4"]
    unit: Unit
    notes: tuple[str, ...] = ()  # a line each on what was guessed or left out


def read_object(path: Path, config: ReadingConfig) -> ReadObject:
    """Read GLB, GLTF, OBJ, PLY or STL. ObjectError names what is wrong and what to do."""
    _refuse_unreadable(path, config)
    suffix = path.suffix.lower()
    if suffix in GLTF_SUFFIXES:
        file_mesh = read_gltf(
            path,
            path.read_bytes(),
            max_file_mb=config.max_file_mb,
            max_image_px=config.max_image_px,
            max_faces=config.max_faces,
        )
        return object_mesh(file_mesh, path, config, unit="m", up_axis="y")
    customary: Unit | None = None
    if suffix == ".obj":
        file_mesh = read_obj(path, max_file_mb=config.max_file_mb)
    elif suffix == ".ply":
        file_mesh = read_ply(path, path.read_bytes(), max_file_mb=config.max_file_mb)
    elif suffix == ".stl":
        file_mesh, customary = read_stl(path, path.read_bytes()), "mm"  # what slicers take
    else:
        raise ObjectError(
            path,
            f"{suffix or 'no suffix'!r} is not a mesh format read here",
            expected=", ".join(MESH_SUFFIXES),
            action="Convert the mesh, for instance with Blender.",
        )
    return object_mesh(
        file_mesh, path, config, unit=config.unit, customary_unit=customary, up_axis=config.up_axis
    )


def _refuse_unreadable(path: Path, config: ReadingConfig) -> None:
    try:
        if not path.is_file():
            raise ObjectError(path, "does not exist", expected="a mesh file", action="Check the path.")
        size = path.stat().st_size
        path.open("rb").close()
    except OSError as error:
        raise ObjectError(
            path,
            f"cannot be read ({error.strerror})",
            expected="a mesh file that this user may read",
            action="Check the permissions of the file and its folders.",
        ) from error
    if size == 0:
        raise ObjectError(path, "is empty (0 bytes)", expected="a mesh", action="Copy the file again.")
    if size > config.max_file_mb * 1e6:
        raise ObjectError(
            path,
            f"has {size / 1e6:.0f} MB",
            expected=f"at most {config.max_file_mb:g} MB",
            action="Make the model smaller or raise `max_file_mb`.",
        )


def object_mesh(
    file_mesh: FileMesh,
    source: Path,
    config: ReadingConfig,
    *,
    unit: Unit | Literal["auto"],
    up_axis: Literal["y", "z"],
    customary_unit: Unit | None = None,
) -> ReadObject:
    """Check a mesh, weld its vertices and place it in the object frame.

    `customary_unit` is what "auto" takes where several units are plausible.
    """
    _refuse_unusable(file_mesh, source, config)
    verts, faces, kept = _welded(file_mesh.verts_file, file_mesh.faces)
    if len(faces) == 0:
        raise _no_extent(source)
    rotation = ROTATION_FROM_Y_UP if up_axis == "y" else np.eye(3)
    longest = float(np.ptp(verts, axis=0).max())
    chosen, unit_notes = unit_of_size(longest, customary=customary_unit) if unit == "auto" else (unit, ())
    metres = METRES_PER[chosen]
    verts_metric = verts @ rotation.T * metres
    center = 0.5 * (verts_metric.min(axis=0) + verts_metric.max(axis=0))
    T_obj_from_file = np.eye(4)
    T_obj_from_file[:3, :3] = rotation * metres
    T_obj_from_file[:3, 3] = -center
    tint = None if file_mesh.corner_colors is None else file_mesh.corner_colors[kept]
    mesh = ObjectMesh(
        verts_obj=verts_metric - center,
        faces=faces,
        corner_uv=file_mesh.corner_uv[kept],
        face_material=file_mesh.face_material[kept],
        materials=_permitted_materials(file_mesh.materials, source, config.max_image_px),
        corner_colors=_tint(tint, source),
        more_corner_uv=tuple(uv[kept] for uv in file_mesh.more_corner_uv),
    )
    notes = (*file_mesh.notes, *unit_notes)
    return ReadObject(mesh=mesh, T_obj_from_file=T_obj_from_file, unit=chosen, notes=notes)


def _welded(
    verts: Float[np.ndarray, "vert 3"], faces: np.ndarray
) -> tuple[Float[np.ndarray, "used 3"], np.ndarray, np.ndarray]:
    """Exactly equal positions become one vertex, so shading is smooth across UV seams.

    Returns used vertices, faces without zero-area ones, and which faces were kept.
    """
    unique, inverse = np.unique(verts[faces.reshape(-1)], axis=0, return_inverse=True)
    welded = inverse.reshape(-1, 3)
    a, b, c = (unique[welded[:, k]] for k in range(3))
    doubled_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.ptp(unique, axis=0).max() if len(unique) else 0.0
    kept = doubled_area > 1e-14 * longest**2
    used, compact = np.unique(welded[kept], return_inverse=True)
    return unique[used], compact.reshape(-1, 3).astype(np.int64), kept


def _no_extent(source: Path) -> ObjectError:
    return ObjectError(
        source,
        "has no extent (every triangle has zero area)",
        expected="a surface in three dimensions",
        action="Export the mesh again; a scale of 0 is a common cause.",
    )


def _refuse_unusable(file_mesh: FileMesh, source: Path, config: ReadingConfig) -> None:
    n_faces = len(file_mesh.faces)
    if n_faces == 0:
        raise ObjectError(
            source,
            f"has no faces ({len(file_mesh.verts_file)} vertices)",
            expected="a triangle mesh",
            action="Point clouds and curves must be meshed first.",
        )
    refuse_too_many_faces(n_faces, source, config.max_faces)
    used = file_mesh.verts_file[np.unique(file_mesh.faces)]
    bad = int((~np.isfinite(used)).any(axis=1).sum())
    if bad:
        raise ObjectError(
            source,
            f"{bad} of {len(used)} vertices are NaN or infinite",
            expected="finite coordinates",
            action="Export the mesh again; degenerate modifiers are a common cause.",
        )
    if not np.ptp(used, axis=0).max() > 0.0:
        raise _no_extent(source)


def _permitted_materials(
    materials: tuple[Material, ...], source: Path, max_image_px: int
) -> tuple[Material, ...]:
    """The materials with images as glTF permits them, each image decoded once to see that it is whole."""
    done: dict[bytes, bytes] = {}

    def permitted(image: bytes | None, name: str) -> bytes | None:
        if image is not None and image not in done:
            done[image] = permitted_image(image, source, f"an image of material {name!r}", max_image_px)
        return None if image is None else done[image]

    return tuple(
        replace(
            material,
            base_color_image=permitted(material.base_color_image, material.name),
            metallic_roughness_image=permitted(material.metallic_roughness_image, material.name),
            normal_image=permitted(material.normal_image, material.name),
            emissive_image=permitted(material.emissive_image, material.name),
        )
        for material in materials
    )


def _tint(
    corner_colors: Float[np.ndarray, "face 3 rgb"] | None, source: Path
) -> Float[np.ndarray, "face 3 rgb"] | None:
    """Factors 0..1; None where all are 1."""
    if corner_colors is None:
        return None
    if not np.isfinite(corner_colors).all():
        raise ObjectError(
            source,
            "has vertex colours that are NaN or infinite",
            expected="colours in 0..1",
            action="Export the mesh again, or without vertex colours.",
        )
    clipped = np.clip(corner_colors, 0.0, 1.0)
    return None if (clipped == 1.0).all() else clipped
