"""What moves is no rigid object: skins, animations and morph targets that reach something drawn."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from datagen.objects.errors import ObjectError
from datagen.objects.gltf.container import GltfFile
from datagen.objects.gltf.nodes import PlacedMesh

__all__ = ["refuse_what_moves"]

STILL = 1e-6  # change of a value over an animation that moves nothing
POINTER = "KHR_animation_pointer"


def refuse_what_moves(file: GltfFile, placed: Sequence[PlacedMesh]) -> tuple[str, ...]:
    """Notes on animations that hold still what is drawn; ObjectError where something moves.

    Skins that no drawn node uses, animations of cameras and bones alone, and animations without a
    change are left out: the nodes' own pose is drawn.
    """
    drawn = {mesh.lineage[-1] for mesh in placed}
    moving_nodes = {node for mesh in placed for node in mesh.lineage}
    if any("skin" in file.entry("nodes", node) for node in drawn):
        raise _moving(file, f"is skinned ({len(file.json.get('skins', []))} skins)")
    animations = file.json.get("animations", [])
    touching = [
        (animation, channel)
        for animation in animations
        for channel in animation.get("channels", [])
        if _target(channel)[0] in moving_nodes
    ]
    moves = [_target(channel)[1] for animation, channel in touching if _changes(file, animation, channel)]
    if moves:
        what = "animates morph targets" if "weights" in moves else "is animated"
        raise _moving(file, f"{what} ({len(animations)} animations)")
    n_morphed = sum(_is_morphed(file, mesh) for mesh in placed)
    if n_morphed:
        raise _moving(file, f"is deformed by morph targets ({n_morphed} with weights)")
    return ("its animation holds still; drawn in the pose of its nodes",) if touching else ()


def _target(channel: dict[str, Any]) -> tuple[object, str]:
    """Node and property of a channel; (None, "") where it is neither a node's nor known."""
    target = channel.get("target", {})
    pointer = target.get("extensions", {}).get(POINTER, {}).get("pointer")
    if pointer is None:
        return target.get("node"), str(target.get("path", ""))
    parts = str(pointer).split("/")  # "/nodes/3/translation"
    if len(parts) >= 4 and parts[1] == "nodes" and parts[2].isdecimal():
        return int(parts[2]), parts[3]
    return None, ""


def _changes(file: GltfFile, animation: dict[str, Any], channel: dict[str, Any]) -> bool:
    """Whether the values of a channel differ from one key to another, or between keys."""
    index = channel["sampler"]
    if type(index) is not int or index < 0:
        raise file.damaged(f"an animation refers to samplers[{index!r}]")
    sampler = animation["samplers"][index]
    n_keys = len(file.accessor(sampler["input"]))
    if n_keys < 2:
        return False
    is_cubic = sampler.get("interpolation") == "CUBICSPLINE"
    rows = file.accessor(sampler["output"]).astype(np.float64)
    if len(rows) % (n_keys * (3 if is_cubic else 1)):
        raise file.damaged(f"an animation has {n_keys} keys and {len(rows)} values")
    keys = rows.reshape(n_keys, 3 if is_cubic else 1, -1)
    values = keys[:, 1 if is_cubic else 0]
    moving_tangents = is_cubic and float(np.abs(keys[:, [0, 2]]).max()) > STILL
    return moving_tangents or not float(np.ptp(values, axis=0).max()) <= STILL


def _is_morphed(file: GltfFile, placed: PlacedMesh) -> bool:
    node, mesh = file.entry("nodes", placed.lineage[-1]), file.entry("meshes", placed.mesh)
    return any(node.get("weights", mesh.get("weights", [])))


def _moving(file: GltfFile, problem: str) -> ObjectError:
    return ObjectError(
        file.path,
        problem,
        expected="one rigid object",
        action="Apply the pose in Blender and export without animation.",
    )
