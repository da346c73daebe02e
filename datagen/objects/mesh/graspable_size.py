"""What one hand can hold, and by how much a larger object must shrink."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from datagen.objects.errors import ObjectError
from datagen.objects.mesh.object_mesh import ObjectMesh

__all__ = [
    "HELD_LONGEST_M",
    "HOLDABLE_SIDES_M",
    "fitted_scale",
    "holdable_scale",
    "refuse_unheld_size",
    "scaled_mesh",
]

# Upper limits of the smallest, middle and longest bbox side. GraspXL scales its "large" set to a
# smallest side of 7 to 8.5 cm; the others keep weight and reach plausible.
HOLDABLE_SIDES_M = (0.075, 0.14, 0.26)
# Longest bbox side of what a hand holds at all, thin or by one end. The synthesiser closes on 1 to
# 105 mm of thickness; a watertight mesh of 5 mm has 17 of the smallest voxels, and 1 m is nearly four
# times the limit above, more than any object of GraspXL.
HELD_LONGEST_M = (0.005, 1.0)


def holdable_scale(size_m: Float[np.ndarray, "3"]) -> float:
    """Largest isotropic factor <= 1 that brings a bbox within HOLDABLE_SIDES_M."""
    return min(1.0, fitted_scale(size_m))


def fitted_scale(size: Float[np.ndarray, "3"]) -> float:
    """Isotropic factor that makes a bbox as large as HOLDABLE_SIDES_M allows, for sizes without meaning."""
    sides = np.maximum(np.sort(size), 1e-9 * size.max())  # a sheet may have no thickness
    return float((np.array(HOLDABLE_SIDES_M) / sides).min())


def refuse_unheld_size(mesh: ObjectMesh, source: object) -> None:
    """ObjectError where no hand holds a thing of this size: its unit is not what was taken."""
    longest_m = float(np.ptp(mesh.verts_obj, axis=0).max())
    lowest, highest = HELD_LONGEST_M
    if not lowest <= longest_m <= highest:
        raise ObjectError(
            source,
            f"has a longest side of {longest_m:.3g} m",
            expected=f"{lowest:g} to {highest:g} m, what one hand can hold",
            action="State the unit in `objects.reading.unit`, or scale the mesh (glTF is always in metres).",
        )


def scaled_mesh(mesh: ObjectMesh, factor: float) -> ObjectMesh:
    """The same mesh, larger or smaller about the origin."""
    return replace(mesh, verts_obj=mesh.verts_obj * factor)
