"""Meshes and voxels as files: GLB (Y up, linear vertex colours) and PLY (Z up, sRGB)."""

from itertools import product
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Float32, Int
from trimesh.exchange.gltf import export_glb
from trimesh.exchange.ply import export_ply

from model.surface.mesh import SurfaceMesh, vertex_normals
from shards.color import linear_from_srgb

__all__ = ["glb_bytes", "voxel_mesh", "voxels_ply"]

# glTF is Y up: (x, y, z) of the object becomes (x, z, -y), as in the GLBs of the shards.
ROTATION_YUP_FROM_OBJ = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_ROUGHNESS = 0.6


def glb_bytes(mesh: SurfaceMesh, T_objmesh_from_canonical: Float[np.ndarray, "4 4"]) -> bytes:
    """Binary glTF 2.0 with normals and float COLOR_0, which glTF wants in linear light.

    `T_objmesh_from_canonical` (uniform scale and translation) leads to metres in the object's own frame, so that the
    file lies on the shard's mesh; the identity keeps canonical units.
    """
    linear = T_objmesh_from_canonical[:3, :3]
    points = mesh.vertices @ linear.T + T_objmesh_from_canonical[:3, 3]
    material = trimesh.visual.material.PBRMaterial(
        name="surface", baseColorFactor=[255, 255, 255, 255], metallicFactor=0.0, roughnessFactor=_ROUGHNESS
    )
    shape = trimesh.Trimesh(
        vertices=points @ ROTATION_YUP_FROM_OBJ.T,
        faces=mesh.faces,
        vertex_normals=vertex_normals(mesh) @ ROTATION_YUP_FROM_OBJ.T,
        visual=trimesh.visual.TextureVisuals(material=material),
        vertex_attributes={"_COLOR_0": linear_from_srgb(np.clip(mesh.colors, 0.0, 1.0))},
        process=False,
    )
    return export_glb(shape, include_normals=True, tree_postprocessor=_name_colors)


def _name_colors(tree: dict[str, Any]) -> None:
    """trimesh writes colours with 8 bits, too few for linear light in the dark; ours are an attribute, renamed here."""
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["COLOR_0"] = attributes.pop("_COLOR_0")


def voxel_mesh(
    voxels: Int[np.ndarray, "voxel 3"], resolution: int, colors: Float32[np.ndarray, "voxel 3"]
) -> SurfaceMesh:
    """Sides of the voxels that no other voxel covers, canonical frame; each with its own corners, so shading is flat.

    Colours are sRGB, 0..1. For viewing: where voxels touch along an edge only, it is not a manifold.
    """
    filled = np.zeros((resolution + 2,) * 3, dtype=bool)
    i, j, k = (voxels + 1).T
    filled[i, j, k] = True
    corners, owners = [], []
    for axis, side in product(range(3), (0, 1)):
        normal, u, v = np.roll(np.eye(3, dtype=int), -axis, axis=0)
        beside = voxels + 1 + (2 * side - 1) * normal
        bare = np.flatnonzero(~filled[beside[:, 0], beside[:, 1], beside[:, 2]])
        ring = side * normal + (np.stack([0 * u, u, u + v, v]) if side else np.stack([0 * u, v, u + v, u]))
        corners.append(voxels[bare][:, None] + ring)
        owners.append(bare)
    quads = np.concatenate(corners)
    first = 4 * np.arange(len(quads))[:, None, None]
    return SurfaceMesh(
        vertices=(quads.reshape(-1, 3) / resolution - 0.5).astype(np.float32),
        faces=(first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3).astype(np.int32),
        colors=np.repeat(colors[np.concatenate(owners)], 4, axis=0),
    )


def voxels_ply(
    voxels: Int[np.ndarray, "voxel 3"], resolution: int, colors: Float32[np.ndarray, "voxel 3"]
) -> bytes:
    """Binary PLY of `voxel_mesh`, canonical frame (Z up), 8-bit sRGB vertex colours."""
    mesh = voxel_mesh(voxels, resolution, colors)
    shape = trimesh.Trimesh(
        vertices=mesh.vertices,
        faces=mesh.faces,
        vertex_colors=np.round(255.0 * np.clip(mesh.colors, 0.0, 1.0)).astype(np.uint8),
        process=False,
    )
    return export_ply(shape)
