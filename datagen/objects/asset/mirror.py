"""The mirror image of an object: twice the shapes, and left hands for recordings of right ones."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from datagen.objects.asset.object_asset import ConvexPart, ObjectAsset, WatertightMesh
from datagen.objects.mesh.object_mesh import ObjectMesh
from shards.splits import identity_and_variant

__all__ = ["is_mirrored", "mirrored_asset", "mirrored_uid", "unmirrored_uid"]

MIRRORED = "mirrored"
MIRROR_X = np.diag([-1.0, 1.0, 1.0])


def mirrored_asset(asset: ObjectAsset) -> ObjectAsset:
    """The object under x -> -x in its own frame. Twice mirrored it is itself.

    Corners change order, so faces stay outward, and UVs and colours move with them. `T_obj_from_file` (and the
    registration) gets the reflection, so it still leads from the file to this object frame; its
    determinant changes sign.
    """
    T_mirror = np.eye(4)
    T_mirror[:3, :3] = MIRROR_X
    registration = asset.registration
    if registration is not None:
        T = T_mirror @ registration.T_rescaled_from_original
        registration = replace(registration, T_rescaled_from_original=T)
    uid = unmirrored_uid(asset.uid) if is_mirrored(asset.uid) else mirrored_uid(asset.uid)
    return replace(
        asset,
        uid=uid,
        mesh=_mirrored_mesh(asset.mesh),
        watertight=_mirrored_watertight(asset.watertight),
        T_obj_from_file=T_mirror @ asset.T_obj_from_file,
        registration=registration,
    )


def mirrored_uid(uid: str) -> str:
    """ "a/b" -> "a/b@mirrored", "a/b@large" -> "a/b@large-mirrored"."""
    _, variant = identity_and_variant(uid)
    return f"{uid}-{MIRRORED}" if variant else f"{uid}@{MIRRORED}"


def is_mirrored(uid: str) -> bool:
    """Whether the uid names a mirror image."""
    _, variant = identity_and_variant(uid)
    return variant == f"@{MIRRORED}" or variant.endswith(f"-{MIRRORED}")


def unmirrored_uid(uid: str) -> str:
    """The uid of the object itself; unchanged where it is no mirror image."""
    return uid[: -len(MIRRORED) - 1] if is_mirrored(uid) else uid


def _mirrored_points(points: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point 3"]:
    return points @ MIRROR_X


def _mirrored_mesh(mesh: ObjectMesh) -> ObjectMesh:
    return mesh.with_corners(
        lambda rows: np.ascontiguousarray(rows[:, ::-1]),
        verts_obj=_mirrored_points(mesh.verts_obj),
        faces=np.ascontiguousarray(mesh.faces[:, ::-1]),
    )


def _mirrored_watertight(watertight: WatertightMesh) -> WatertightMesh:
    return replace(
        watertight,
        verts_obj=_mirrored_points(watertight.verts_obj),
        faces=np.ascontiguousarray(watertight.faces[:, ::-1]),
        parts=tuple(
            ConvexPart(
                verts_obj=_mirrored_points(part.verts_obj), faces=np.ascontiguousarray(part.faces[:, ::-1])
            )
            for part in watertight.parts
        ),
    )
