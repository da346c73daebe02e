"""The node tree of a glTF scene: what is drawn, and where (FORMATS 10.4)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from datagen.objects.gltf.container import GltfFile

__all__ = ["INSTANCING", "VISIBILITY", "PlacedMesh", "placed_meshes"]

INSTANCING = "EXT_mesh_gpu_instancing"
VISIBILITY = "KHR_node_visibility"


@dataclass(frozen=True, kw_only=True)
class PlacedMesh:
    """A node of the default scene that draws a mesh."""

    mesh: int
    T_scene_from_instance: Float[np.ndarray, "instance 4 4"]  # one where the node is not instanced
    lineage: tuple[int, ...]  # from the root to the node itself


def placed_meshes(file: GltfFile) -> list[PlacedMesh]:
    """Every mesh below the default scene in file order, hidden nodes and what is below them left out."""
    nodes = file.json.get("nodes", [])
    placed, visited = [], 0
    stack: list[tuple[int, Float[np.ndarray, "4 4"], tuple[int, ...]]]
    stack = [(root, np.eye(4), ()) for root in reversed(_roots(file))]
    while stack:
        index, T_scene_from_parent, ancestors = stack.pop()
        visited += 1
        if visited > len(nodes):
            raise file.damaged("its node tree has a cycle")
        node = file.entry("nodes", index)
        extensions = node.get("extensions", {})
        if extensions.get(VISIBILITY, {}).get("visible", True) is False:
            continue
        T_scene_from_node, lineage = T_scene_from_parent @ _node_matrix(node), (*ancestors, index)
        if "mesh" in node:
            instances = _instances(file, extensions.get(INSTANCING))
            placed.append(
                PlacedMesh(
                    mesh=node["mesh"], T_scene_from_instance=T_scene_from_node @ instances, lineage=lineage
                )
            )
        stack.extend((child, T_scene_from_node, lineage) for child in reversed(node.get("children", [])))
    return placed


def _roots(file: GltfFile) -> list[int]:
    if file.json.get("scenes"):
        return file.entry("scenes", file.json.get("scene", 0)).get("nodes", [])
    nodes = file.json.get("nodes", [])
    below = {child for node in nodes for child in node.get("children", [])}
    # Levels of detail stand in for a node that is drawn already.
    coarser = {
        other for node in nodes for other in node.get("extensions", {}).get("MSFT_lod", {}).get("ids", [])
    }
    return [index for index in range(len(nodes)) if index not in below | coarser]


def _node_matrix(node: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    return _composed(
        np.array([node.get("translation", (0.0, 0.0, 0.0))], dtype=np.float64),
        np.array([node.get("rotation", (0.0, 0.0, 0.0, 1.0))], dtype=np.float64),
        np.array([node.get("scale", (1.0, 1.0, 1.0))], dtype=np.float64),
    )[0]


def _instances(file: GltfFile, instancing: dict[str, Any] | None) -> Float[np.ndarray, "instance 4 4"]:
    """T_node_from_instance of EXT_mesh_gpu_instancing; the identity alone without it."""
    if instancing is None:
        return np.eye(4)[None]
    kinds = {"TRANSLATION": (0.0, 0.0, 0.0), "ROTATION": (0.0, 0.0, 0.0, 1.0), "SCALE": (1.0, 1.0, 1.0)}
    stated = {
        kind: file.accessor(accessor).astype(np.float64)
        for kind, accessor in instancing["attributes"].items()
        if kind in kinds
    }
    counts = {len(rows) for rows in stated.values()}
    if len(counts) > 1:
        raise file.damaged(f"the attributes of {INSTANCING} differ in length")
    count = counts.pop() if counts else 1
    columns = [stated.get(kind, np.tile(default, (count, 1))) for kind, default in kinds.items()]
    for (kind, default), rows in zip(kinds.items(), columns):
        if rows.shape[1] != len(default):
            raise file.damaged(f"{kind} of {INSTANCING} has the shape {rows.shape}")
    return _composed(*columns)


def _composed(
    translation: Float[np.ndarray, "node 3"],
    rotation: Float[np.ndarray, "node 4"],
    scale: Float[np.ndarray, "node 3"],
) -> Float[np.ndarray, "node 4 4"]:
    """T_parent_from_node of translation, unit quaternion (x, y, z, w) and scale."""
    x, y, z, w = rotation.T
    turned = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    T_parent_from_node = np.tile(np.eye(4), (len(scale), 1, 1))
    T_parent_from_node[:, :3, :3] = turned.transpose(2, 0, 1) * scale[:, None]
    T_parent_from_node[:, :3, 3] = translation
    return T_parent_from_node
