"""The surface that a hand must not enter: the object's own mesh, or its watertight mesh where the mesh is open."""

import igl
import numpy as np
from jaxtyping import Float

from datagen.objects.asset.object_asset import ObjectAsset

__all__ = ["ObjectSurface", "verts_in_object"]


class ObjectSurface:
    """Signed distance to the object's own mesh, or to its watertight mesh where the mesh is open."""

    def __init__(self, obj: ObjectAsset) -> None:
        source = obj.mesh if obj.watertight.watertight_source else obj.watertight
        self.verts = np.ascontiguousarray(source.verts_obj, dtype=np.float64)
        self.faces = np.ascontiguousarray(source.faces, dtype=np.int64)
        self.low, self.high = self.verts.min(0), self.verts.max(0)

    def depth(self, points_obj: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, " point"]:
        """How deep each point lies inside (m); 0 outside. Generalised winding number for the sign."""
        depth = np.zeros(len(points_obj))
        near = ((points_obj > self.low) & (points_obj < self.high)).all(1)
        if near.any():
            signed = igl.signed_distance(
                np.ascontiguousarray(points_obj[near]),
                self.verts,
                self.faces,
                igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
            )[0]
            depth[near] = np.maximum(-signed, 0.0)
        return depth

    def distance(self, points_obj: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, " point"]:
        """Signed distance of each point (m), negative inside."""
        signed: Float[np.ndarray, " point"] = igl.signed_distance(
            np.ascontiguousarray(points_obj),
            self.verts,
            self.faces,
            igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
        )[0]
        return signed


def verts_in_object(
    verts_world: Float[np.ndarray, "instant vert 3"], T_world_from_obj: Float[np.ndarray, "instant 4 4"]
) -> Float[np.ndarray, "instant vert 3"]:
    """Hand vertices in the frame of the object, instant by instant."""
    R, t = T_world_from_obj[:, :3, :3], T_world_from_obj[:, :3, 3]
    return np.einsum("tvi,tij->tvj", verts_world - t[:, None], R)
