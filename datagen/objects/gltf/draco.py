"""Draco-compressed primitives of glTF (KHR_draco_mesh_compression)."""

from dataclasses import dataclass
from typing import Any

import DracoPy
import numpy as np
from jaxtyping import Int

from datagen.objects.gltf.container import GltfFile, normalised

__all__ = ["DRACO", "DracoPrimitive", "decoded_primitive"]

DRACO = "KHR_draco_mesh_compression"
TRIANGLES = 4


@dataclass(frozen=True, kw_only=True)
class DracoPrimitive:
    """What one compressed primitive holds; attributes by their glTF names."""

    faces: Int[np.ndarray, "face 3"]
    attributes: dict[str, np.ndarray]  # rows as `GltfFile.accessor` gives them


def decoded_primitive(file: GltfFile, primitive: dict[str, Any]) -> DracoPrimitive | None:
    """The unpacked primitive; None where it is not compressed. ObjectError where it is damaged.

    The extension names each attribute by its unique id in the Draco data; component type and
    normalisation stand in the glTF accessor, as the extension's specification says.
    """
    packed = primitive.get("extensions", {}).get(DRACO)
    if packed is None:
        return None
    if primitive.get("mode", TRIANGLES) != TRIANGLES:
        raise file.damaged(f"a Draco primitive has mode {primitive['mode']} instead of triangles")
    view = packed["bufferView"]
    try:
        mesh = DracoPy.decode(file.view(view))
    except Exception as error:  # DracoPy raises plain Exception and its own types
        raise file.damaged(f"the Draco data of bufferView {view} cannot be decoded ({error})") from error
    if not isinstance(mesh, DracoPy.DracoMesh):
        raise file.damaged(f"the Draco data of bufferView {view} is a point cloud")
    by_id = {attribute["unique_id"]: attribute["data"] for attribute in mesh.attributes}
    attributes = {}
    for name, unique_id in packed["attributes"].items():
        if by_id.get(unique_id) is None:
            raise file.damaged(f"the Draco data of bufferView {view} has no attribute {unique_id} ({name})")
        accessor = file.json["accessors"][primitive["attributes"][name]]
        attributes[name] = normalised(np.asarray(by_id[unique_id]), accessor)
    faces = np.asarray(mesh.faces, dtype=np.int64).reshape(-1, 3)
    return DracoPrimitive(faces=faces, attributes=attributes)
