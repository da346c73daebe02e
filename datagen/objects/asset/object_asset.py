"""ObjectAsset: one object with everything the generator needs to know of it."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from datagen.objects.catalogue.description import Appearance
from datagen.objects.mesh.object_mesh import ObjectMesh
from datagen.objects.mesh.registration import Registration
from datagen.objects.mesh.texture_quality import TextureQuality

__all__ = ["ConvexPart", "ObjectAsset", "WatertightFit", "WatertightMesh"]


@dataclass(frozen=True, kw_only=True)
class ConvexPart:
    """One convex hull of the decomposition, outward faces, object frame, metres."""

    verts_obj: Float[np.ndarray, "vert 3"]
    faces: Int[np.ndarray, "face 3"]


@dataclass(frozen=True, kw_only=True)
class WatertightFit:
    """How far the watertight mesh is from the drawn mesh, and the hulls from the watertight mesh. Metres."""

    deviation_mean_m: float  # solid surface to the nearest point of the drawn mesh
    deviation_p99_m: float
    deviation_max_m: float
    uncovered_max_m: float  # outer points of the drawn mesh to the watertight mesh surface
    # NaN for a watertight mesh without convex parts:
    hull_excess_p99_m: float  # hull surface that lies outside the watertight mesh
    hull_excess_max_m: float
    hull_uncovered_max_m: float  # depth of solid surface points that no hull contains


@dataclass(frozen=True, kw_only=True)
class WatertightMesh:
    """A closed version of the drawn mesh, in the same object frame. Metres.

    Single sheets (a paper cup) have got a thickness; cavities that nothing can reach are filled.
    """

    verts_obj: Float[np.ndarray, "vert 3"]
    faces: Int[np.ndarray, "face 3"]
    parts: tuple[ConvexPart, ...]  # empty where no physics will run (recorded motions)
    watertight_source: bool  # the drawn mesh was closed; its own surface is kept
    fit: WatertightFit | None = None  # None: made by hand, not measured


@dataclass(frozen=True, kw_only=True)
class ObjectAsset:
    """One object. Frame: the mesh's own axes turned Z-up, metres, origin at the bbox centre."""

    uid: str
    name: str
    source: str
    licence: str  # SPDX id ("LicenseRef-..." where there is none), or several that apply: "A AND B"
    author: str
    url: str
    mesh: ObjectMesh
    watertight: WatertightMesh
    catalogue_scale: float  # size here / size in the source (below 1: a miniature)
    texture: TextureQuality
    # Axes, unit and centring in one similarity: x_obj = T_obj_from_file @ x_file.
    T_obj_from_file: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    registration: Registration | None = None  # drawn in place of its rescaled copy (GraspXL)
    appearance: Appearance = "original"
