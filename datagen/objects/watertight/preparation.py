"""From a drawn mesh to an ObjectAsset: outward faces, watertight mesh, convex parts, metrics, cache."""

import hashlib
import io
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path

import igl
import numpy as np
from jaxtyping import Float, Int

from datagen.objects.asset.object_asset import ConvexPart, WatertightFit, WatertightMesh
from datagen.objects.mesh.object_mesh import ObjectMesh
from datagen.objects.mesh.surface_points import sample_surface
from datagen.objects.watertight.convex_parts import ConvexConfig, HullFit, convex_parts
from datagen.objects.watertight.level_set import LevelSetConfig
from datagen.objects.watertight.watertight_mesh import (
    WatertightConfig,
    WatertightSurface,
    signed_distance,
    watertight_surface,
)
from shards.storage.whole_file import write_whole

__all__ = [
    "REFERENCE_PREPARATION",
    "PreparationConfig",
    "cached_watertight",
    "make_watertight",
    "watertight_from_bytes",
    "watertight_to_bytes",
]

CACHE_VERSION = 1  # raise it when the algorithms change: older cache entries are then ignored
N_DEVIATION_POINTS = 20000
NO_HULLS = HullFit(excess_p99_m=float("nan"), excess_max_m=float("nan"), uncovered_max_m=float("nan"))


@dataclass(frozen=True, kw_only=True)
class PreparationConfig:
    """How watertight meshes and convex parts are made."""

    watertight: WatertightConfig
    convex: ConvexConfig


# What the starter pack was built with; libraries of other meshes use the same.
REFERENCE_PREPARATION = PreparationConfig(
    watertight=WatertightConfig(
        level_set=LevelSetConfig(voxels_longest=192, min_voxel_m=0.0003, max_hole_m=0.004, sheet_voxels=1.8),
        tolerance_m=5e-5,
        max_faces=12000,
    ),
    convex=ConvexConfig(
        thresholds=(0.05, 0.025),
        max_hulls=24,
        max_hull_verts=96,
        hull_tolerance_m=0.0002,
        max_excess_m=0.002,
        max_faces=4000,
        mcts_iterations=30,
        seed=0,
    ),
)


def make_watertight(
    mesh: ObjectMesh, config: PreparationConfig, *, source: object, with_parts: bool = True
) -> WatertightMesh:
    """Closed surface, convex parts and their measured fit. Takes seconds; see `cached_watertight`.

    `with_parts=False` leaves out the convex parts, which take most of the time and only physics needs.
    """
    surface = watertight_surface(mesh.verts_obj, mesh.faces, config.watertight, source=source)
    parts, hulls = convex_parts(surface, config.convex) if with_parts else ((), NO_HULLS)
    return WatertightMesh(
        verts_obj=surface.verts_obj,
        faces=surface.faces,
        parts=parts,
        watertight_source=surface.watertight_source,
        fit=_fit(mesh, surface, hulls),
    )


def _fit(mesh: ObjectMesh, surface: WatertightSurface, hulls: HullFit) -> WatertightFit:
    rng = np.random.default_rng(0)
    deviation = _distance_to(surface, mesh, rng)
    drawn = sample_surface(mesh, N_DEVIATION_POINTS, rng).points_obj
    outside = signed_distance(surface.verts_obj, surface.faces, drawn)
    return WatertightFit(
        deviation_mean_m=float(deviation.mean()),
        deviation_p99_m=float(np.percentile(deviation, 99)),
        deviation_max_m=float(deviation.max()),
        uncovered_max_m=float(max(outside.max(), 0.0)),
        hull_excess_p99_m=hulls.excess_p99_m,
        hull_excess_max_m=hulls.excess_max_m,
        hull_uncovered_max_m=hulls.uncovered_max_m,
    )


def _distance_to(
    surface: WatertightSurface, mesh: ObjectMesh, rng: np.random.Generator
) -> Float[np.ndarray, " point"]:
    """Distance of points of the watertight mesh's surface to the drawn mesh."""
    as_mesh = ObjectMesh(
        verts_obj=surface.verts_obj,
        faces=surface.faces,
        corner_uv=np.zeros((len(surface.faces), 3, 2)),
        face_material=np.zeros(len(surface.faces), dtype=np.int64),
        materials=(),
    )
    points = sample_surface(as_mesh, N_DEVIATION_POINTS, rng).points_obj
    squared, _, _ = igl.point_mesh_squared_distance(
        points, np.ascontiguousarray(mesh.verts_obj), np.ascontiguousarray(mesh.faces)
    )
    return np.sqrt(squared)


def _key(
    verts: Float[np.ndarray, "vert 3"],
    faces: Int[np.ndarray, "face 3"],
    config: PreparationConfig,
    with_parts: bool,
) -> str:
    parameters = f"{asdict(config)}" if with_parts else f"{asdict(config.watertight)} without parts"
    digest = hashlib.sha256(f"{CACHE_VERSION} {parameters}".encode())
    digest.update(np.ascontiguousarray(verts, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(faces, dtype="<i8").tobytes())
    return digest.hexdigest()


def cached_watertight(
    mesh: ObjectMesh,
    config: PreparationConfig,
    cache_dir: Path,
    *,
    source: object,
    with_parts: bool = True,
) -> WatertightMesh:
    """`make_watertight`, kept in `cache_dir` under the hash of vertices, faces and parameters.

    A damaged entry is made again. Several processes may share the folder.
    """
    path = cache_dir / f"{_key(mesh.verts_obj, mesh.faces, config, with_parts)}.npz"
    if path.is_file():
        try:
            return watertight_from_bytes(path.read_bytes())
        except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile):
            path.unlink(missing_ok=True)
    # Made from bytes in both cases, so the first load and later ones are equal bit-exactly.
    data = watertight_to_bytes(make_watertight(mesh, config, source=source, with_parts=with_parts))
    cache_dir.mkdir(parents=True, exist_ok=True)
    with write_whole(path) as partial:
        partial.write_bytes(data)
    return watertight_from_bytes(data)


def watertight_to_bytes(watertight: WatertightMesh) -> bytes:
    """An .npz with fixed dates: equal watertight meshes give equal bytes. Vertices are float32."""
    no_verts, no_faces = np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    arrays: dict[str, np.ndarray] = {
        "verts": watertight.verts_obj.astype("<f4"),
        "faces": watertight.faces.astype("<u2" if len(watertight.verts_obj) < 65536 else "<u4"),
        "watertight_source": np.array(watertight.watertight_source),
        "part_verts": np.concatenate([no_verts, *(part.verts_obj for part in watertight.parts)]).astype(
            "<f4"
        ),
        "part_faces": np.concatenate([no_faces, *(part.faces for part in watertight.parts)]).astype("<u2"),
        "part_sizes": np.array(
            [(len(part.verts_obj), len(part.faces)) for part in watertight.parts], dtype="<u2"
        ).reshape(-1, 2),
    }
    if watertight.fit is not None:
        arrays["fit"] = np.array(list(asdict(watertight.fit).values()), dtype="<f8")
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.ascontiguousarray(array), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content.getvalue(), zipfile.ZIP_DEFLATED, 9)
    return buffer.getvalue()


def watertight_from_bytes(data: bytes) -> WatertightMesh:
    """Inverse of `watertight_to_bytes` up to float32."""
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        part_verts, part_faces = arrays["part_verts"], arrays["part_faces"]
        ends = np.cumsum(arrays["part_sizes"].astype(np.int64), axis=0)
        starts = ends - arrays["part_sizes"]
        parts = tuple(
            ConvexPart(
                verts_obj=part_verts[start[0] : end[0]].astype(np.float64),
                faces=part_faces[start[1] : end[1]].astype(np.int64),
            )
            for start, end in zip(starts, ends)
        )
        return WatertightMesh(
            verts_obj=arrays["verts"].astype(np.float64),
            faces=arrays["faces"].astype(np.int64),
            parts=parts,
            watertight_source=bool(arrays["watertight_source"]),
            fit=WatertightFit(**dict(zip(WatertightFit.__dataclass_fields__, map(float, arrays["fit"]))))
            if "fit" in arrays
            else None,
        )
