"""FileMesh: a mesh as its file states it, before axes, unit and centre are settled."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from datagen.objects.errors import ObjectError
from datagen.objects.mesh.object_mesh import Material

__all__ = ["FileMesh", "refuse_too_many_faces"]


@dataclass(frozen=True, kw_only=True)
class FileMesh:
    """Triangles in the file's own axes and unit."""

    verts_file: Float[np.ndarray, "vert 3"]
    faces: Int[np.ndarray, "face 3"]
    corner_uv: Float[np.ndarray, "face 3 2"]  # (0, 0) is the lower left of the image
    face_material: Int[np.ndarray, " face"]
    materials: tuple[Material, ...]
    # Linear factors that multiply base colour and image; None where no face has one, 1 where a face has none.
    corner_colors: Float[np.ndarray, "face 3 rgb"] | None
    more_corner_uv: tuple[Float[np.ndarray, "face 3 2"], ...] = ()  # `ImageLayout.uv_layer` 1, 2 ...
    notes: tuple[str, ...] = ()  # a line each on what was guessed or left out


def refuse_too_many_faces(n_faces: int, source: object, max_faces: int) -> None:
    """ObjectError where a file has more triangles than it may."""
    if n_faces > max_faces:
        raise ObjectError(
            source,
            f"has {n_faces:,} triangles",
            expected=f"at most {max_faces:,}",
            action="Decimate the mesh or raise `max_faces`.",
        )
