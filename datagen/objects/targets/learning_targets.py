"""Learning targets: what the network is taught about an object's shape and colour.

Canonical frame: the mesh's own axes (Z up), bbox centre 0, longest bbox side of the drawn mesh 1.
All targets describe the *watertight* mesh, with no hidden inner geometry.
"""

import hashlib
from dataclasses import dataclass
from typing import Annotated

import igl
import numpy as np
from jaxtyping import Float, Float32, UInt8

from datagen.objects.asset.object_asset import ObjectAsset, WatertightMesh
from datagen.objects.mesh.object_mesh import ObjectMesh
from datagen.objects.mesh.surface_points import colors_at, sample_surface
from datagen.objects.targets.occupancy import surface_voxels
from datagen.objects.watertight.watertight_mesh import signed_distance
from shards.settings import Range

__all__ = ["LearningTargets", "TargetsConfig", "learning_targets"]

RESOLUTION = 64


@dataclass(frozen=True, kw_only=True)
class TargetsConfig:
    """How many samples are stored per object."""

    surface_points: Annotated[int, Range(1, 10_000_000)]
    # around the surface, normal offsets from N(0, sigma)
    sdf_near_points: Annotated[int, Range(1, 10_000_000)]
    sdf_near_sigma: Annotated[float, Range(0, 1)]  # canonical units (1 = longest side)
    sdf_uniform_points: Annotated[int, Range(1, 10_000_000)]  # in [-0.5, 0.5]^3


@dataclass(frozen=True, kw_only=True)
class LearningTargets:
    """Canonical frame and unit throughout; `x_objmesh = T_objmesh_from_canonical @ x_canonical`."""

    # Voxels that the watertight mesh's surface passes through, as TRELLIS' sparse structure (not its inside).
    occupancy_64: UInt8[np.ndarray, "voxel 3"]
    surface_points: Float32[np.ndarray, "point 3"]
    surface_normals: Float32[np.ndarray, "point 3"]
    surface_colors: UInt8[np.ndarray, "point 3"]  # sRGB base colour, no lighting
    sdf_points: Float32[np.ndarray, "sample 3"]
    sdf_values: Float32[np.ndarray, " sample"]  # negative inside
    object_scale_m: float  # longest bbox side in metres
    T_objmesh_from_canonical: Float[np.ndarray, "4 4"]


def learning_targets(asset: ObjectAsset, seed: int, config: TargetsConfig) -> LearningTargets:
    """Occupancy, surface samples and signed distances of one object. Same seed, same bytes."""
    digest = hashlib.sha256(asset.uid.encode()).digest()
    rng = np.random.default_rng([seed, int.from_bytes(digest[:8], "little")])
    both = np.concatenate([asset.mesh.verts_obj, asset.watertight.verts_obj])  # sheets are thickened there
    low, high = both.min(axis=0), both.max(axis=0)
    scale_m, center = float((high - low).max()), 0.5 * (low + high)
    verts = (asset.watertight.verts_obj - center) / scale_m
    faces = asset.watertight.faces
    watertight = _as_mesh(asset.watertight)
    surface = sample_surface(watertight, config.surface_points, rng)
    near = sample_surface(watertight, config.sdf_near_points, rng)
    offset = config.sdf_near_sigma * rng.standard_normal((config.sdf_near_points, 1))
    sdf_points = np.concatenate(
        [
            (near.points_obj - center) / scale_m + offset * near.normals_obj,
            rng.uniform(-0.5, 0.5, (config.sdf_uniform_points, 3)),
        ]
    ).astype(np.float32)
    T_objmesh_from_canonical = np.diag([scale_m, scale_m, scale_m, 1.0])
    T_objmesh_from_canonical[:3, 3] = center
    return LearningTargets(
        occupancy_64=surface_voxels(verts, faces, RESOLUTION),
        surface_points=((surface.points_obj - center) / scale_m).astype(np.float32),
        surface_normals=surface.normals_obj.astype(np.float32),
        surface_colors=_drawn_colors(asset.mesh, surface.points_obj),
        sdf_points=sdf_points,
        sdf_values=signed_distance(verts, faces, sdf_points).astype(np.float32),
        object_scale_m=scale_m,
        T_objmesh_from_canonical=T_objmesh_from_canonical,
    )


def _as_mesh(watertight: WatertightMesh) -> ObjectMesh:
    return ObjectMesh(
        verts_obj=watertight.verts_obj,
        faces=watertight.faces,
        corner_uv=np.zeros((len(watertight.faces), 3, 2)),
        face_material=np.zeros(len(watertight.faces), dtype=np.int64),
        materials=(),
    )


def _drawn_colors(mesh: ObjectMesh, points_obj: Float[np.ndarray, "point 3"]) -> UInt8[np.ndarray, "point 3"]:
    """Colour of the drawn surface nearest to each point."""
    verts, faces = np.ascontiguousarray(mesh.verts_obj), np.ascontiguousarray(mesh.faces)
    _, face, nearest = igl.point_mesh_squared_distance(np.ascontiguousarray(points_obj), verts, faces)
    corners = verts[faces[face]]
    barycentric = igl.barycentric_coordinates(
        nearest, *(np.ascontiguousarray(corners[:, k]) for k in range(3))
    )
    colors = colors_at(mesh, face.astype(np.int64), np.clip(barycentric, 0.0, 1.0))
    return np.round(np.clip(colors, 0.0, 1.0) * 255).astype(np.uint8)
