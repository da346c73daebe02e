"""What one hand can hold, and by how much a larger object must shrink."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from datagen.objects.mesh.object_mesh import ObjectMesh

__all__ = ["HOLDABLE_SIDES_M", "fitted_scale", "holdable_scale", "scaled_mesh"]

# Upper limits of the smallest, middle and longest bbox side. GraspXL scales its "large" set to a
# smallest side of 7 to 8.5 cm; the others keep weight and reach plausible.
HOLDABLE_SIDES_M = (0.075, 0.14, 0.26)


def holdable_scale(size_m: Float[np.ndarray, "3"]) -> float:
    """Largest isotropic factor <= 1 that brings a bbox within HOLDABLE_SIDES_M."""
    return min(1.0, fitted_scale(size_m))


def fitted_scale(size: Float[np.ndarray, "3"]) -> float:
    """Isotropic factor that makes a bbox as large as HOLDABLE_SIDES_M allows, for sizes without meaning."""
    sides = np.maximum(np.sort(size), 1e-9 * size.max())  # a sheet may have no thickness
    return float((np.array(HOLDABLE_SIDES_M) / sides).min())


def scaled_mesh(mesh: ObjectMesh, factor: float) -> ObjectMesh:
    """The same mesh, larger or smaller about the origin."""
    return replace(mesh, verts_obj=mesh.verts_obj * factor)
