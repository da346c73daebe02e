"""Any mesh file to an ObjectMesh in the object frame: axes, unit, centre, refusals."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import trimesh
from jaxtyping import Float
from PIL import Image
from trimesh.visual import ColorVisuals

from datagen.objects.errors import ObjectError
from datagen.objects.formats.vertex_colors import baked_vertex_colors
from datagen.objects.formats.wavefront import read_obj
from datagen.objects.gltf.container import MAX_FILE_MB
from datagen.objects.gltf.scene import read_gltf
from datagen.objects.mesh.file_mesh import FileMesh
from datagen.objects.mesh.object_mesh import Material, ObjectMesh
from shards.color import linear_from_srgb
from shards.settings import Range

__all__ = ["MESH_SUFFIXES", "ReadObject", "ReadingConfig", "object_mesh", "read_object"]

MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
METRES_PER = {"m": 1.0, "cm": 0.01, "mm": 0.001}
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
    unit: Literal["m", "cm", "mm"]


def read_object(path: Path, config: ReadingConfig) -> ReadObject:
    """Read GLB, GLTF, OBJ, PLY or STL. ObjectError names what is wrong and what to do."""
    if not path.is_file():
        raise ObjectError(path, "does not exist", expected="a mesh file", action="Check the path.")
    if path.stat().st_size == 0:
        raise ObjectError(path, "is empty (0 bytes)", expected="a mesh", action="Copy the file again.")
    if path.stat().st_size > config.max_file_mb * 1e6:
        raise ObjectError(
            path,
            f"has {path.stat().st_size / 1e6:.0f} MB",
            expected=f"at most {config.max_file_mb:g} MB",
            action="Make the model smaller or raise `max_file_mb`.",
        )
    suffix = path.suffix.lower()
    if suffix in GLTF_SUFFIXES:
        file_mesh = read_gltf(path, path.read_bytes(), max_file_mb=config.max_file_mb)
        return object_mesh(file_mesh, path, config, unit="m", up_axis="y")
    if suffix == ".obj":
        file_mesh = read_obj(path)
    elif suffix in (".ply", ".stl"):
        file_mesh = _read_ply_or_stl(path)
    else:
        raise ObjectError(
            path,
            f"{suffix or 'no suffix'!r} is not a mesh format read here",
            expected=", ".join(MESH_SUFFIXES),
            action="Convert the mesh, for instance with Blender.",
        )
    return object_mesh(file_mesh, path, config, unit=config.unit, up_axis=config.up_axis)


def _read_ply_or_stl(path: Path) -> FileMesh:
    try:
        loaded = trimesh.load(path, process=False)
    except Exception as error:  # trimesh raises whatever its parsers raise
        raise ObjectError(
            path,
            f"cannot be parsed ({type(error).__name__}: {error})",
            expected=f"a valid {path.suffix[1:].upper()} mesh",
            action="Export the mesh again, for instance with Blender.",
        ) from error
    if not isinstance(loaded, trimesh.Trimesh):
        loaded = trimesh.Trimesh()  # a point cloud: refused below for having no faces
    faces = np.asarray(loaded.faces, dtype=np.int64).reshape(-1, 3)
    colors = None
    # PLY colours are display colours by custom.
    visual = loaded.visual
    if isinstance(visual, ColorVisuals) and visual.kind == "face":
        by_face = np.asarray(visual.face_colors, dtype=np.float64)[:, :3] / 255.0
        colors = np.repeat(linear_from_srgb(by_face)[:, None], 3, axis=1)
    elif isinstance(visual, ColorVisuals) and visual.kind == "vertex":
        by_vertex = np.asarray(visual.vertex_colors, dtype=np.float64)[:, :3] / 255.0
        colors = linear_from_srgb(by_vertex)[faces]
    plain = Material(name="plain", base_color_rgba=(0.6, 0.6, 0.6, 1.0))
    return FileMesh(
        verts_file=np.asarray(loaded.vertices, dtype=np.float64).reshape(-1, 3),
        faces=faces,
        corner_uv=np.zeros((len(faces), 3, 2)),
        face_material=np.zeros(len(faces), dtype=np.int64),
        materials=(plain,),
        corner_colors=colors,
    )


def object_mesh(
    file_mesh: FileMesh,
    source: Path,
    config: ReadingConfig,
    *,
    unit: Literal["m", "cm", "mm", "auto"],
    up_axis: Literal["y", "z"],
) -> ReadObject:
    """Check a mesh, weld its vertices and place it in the object frame."""
    _refuse_unusable(file_mesh, source, config)
    verts, faces, kept = _welded(file_mesh.verts_file, file_mesh.faces)
    if len(faces) == 0:
        raise _no_extent(source)
    rotation = ROTATION_FROM_Y_UP if up_axis == "y" else np.eye(3)
    chosen = unit_of_size(float(np.ptp(verts, axis=0).max())) if unit == "auto" else unit
    metres = METRES_PER[chosen]
    verts_metric = verts @ rotation.T * metres
    center = 0.5 * (verts_metric.min(axis=0) + verts_metric.max(axis=0))
    T_obj_from_file = np.eye(4)
    T_obj_from_file[:3, :3] = rotation * metres
    T_obj_from_file[:3, 3] = -center
    corner_uv, materials = file_mesh.corner_uv[kept], file_mesh.materials
    face_material = file_mesh.face_material[kept]
    if file_mesh.corner_colors is not None and all(m.base_color_image is None for m in materials):
        image, corner_uv = baked_vertex_colors(np.clip(file_mesh.corner_colors[kept], 0.0, 1.0))
        first = materials[0]
        materials = (_with_image(first, image),)
        face_material = np.zeros(len(faces), dtype=np.int64)
    mesh = ObjectMesh(
        verts_obj=verts_metric - center,
        faces=faces,
        corner_uv=corner_uv,
        face_material=face_material,
        materials=materials,
    )
    return ReadObject(mesh=mesh, T_obj_from_file=T_obj_from_file, unit=chosen)


def _with_image(material: Material, image: bytes) -> Material:
    return Material(
        name="vertex_colors",
        base_color_rgba=(1.0, 1.0, 1.0, 1.0),
        base_color_image=image,
        metallic=0.0,
        roughness=max(material.roughness, 0.4),
    )


def unit_of_size(longest: float) -> Literal["m", "cm", "mm"]:
    """The "auto" rule: the unit that makes the longest side 2 cm to 2 m, metres first.

    A hand-held object's longest side read as metres lies in 0.02..2, as centimetres in 2..100
    and as millimetres above; the limits are 2 and 100.
    """
    if longest <= 2.0:
        return "m"
    return "cm" if longest <= 100.0 else "mm"


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
    if n_faces > config.max_faces:
        raise ObjectError(
            source,
            f"has {n_faces:,} triangles",
            expected=f"at most {config.max_faces:,}",
            action="Decimate the mesh or raise `max_faces`.",
        )
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
    for material in file_mesh.materials:
        _refuse_bad_images(material, source, config)


def _refuse_bad_images(material: Material, source: Path, config: ReadingConfig) -> None:
    images = (
        material.base_color_image,
        material.metallic_roughness_image,
        material.normal_image,
        material.emissive_image,
    )
    for image in images:
        if image is None:
            continue
        try:
            opened = Image.open(io.BytesIO(image))
            width, height = opened.size
            if max(width, height) <= config.max_image_px:  # larger ones are not even unpacked
                opened.load()
        except Exception as error:  # Pillow raises whatever its decoders raise
            raise ObjectError(
                source,
                f"an image of material {material.name!r} cannot be decoded ({error})",
                expected="PNG, JPEG or WebP",
                action="Save the image again.",
            ) from error
        if max(width, height) > config.max_image_px:
            raise ObjectError(
                source,
                f"an image of material {material.name!r} is {width}x{height}",
                expected=f"sides of at most {config.max_image_px} px",
                action="Scale the image down or raise `max_image_px`.",
            )
