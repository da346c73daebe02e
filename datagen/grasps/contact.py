"""How far the digits of a posed hand are from an object."""

import numpy as np
from jaxtyping import Float, Int

from datagen.grasps.object_surface import ObjectSurface, verts_in_object
from datagen.hands.model import HandModel
from shards.joints import DIGITS, MANO_JOINTS

__all__ = ["TOUCHING_M", "digit_distances", "digit_of_vertex", "digits_touching", "signed_distances"]

TOUCHING_M = 0.005  # a digit whose skin comes this near the surface touches it


def digit_of_vertex(model: HandModel) -> Int[np.ndarray, " vert"]:
    """Number in DIGITS of the digit that moves each vertex most; -1 on palm and wrist."""
    digit_of_joint = np.array([-1, *(DIGITS.index(name[:-1]) for name in MANO_JOINTS[1:])])
    return digit_of_joint[model.weights.argmax(axis=1)]


def signed_distances(
    surface: ObjectSurface,
    verts_world: Float[np.ndarray, "instant vert 3"],
    T_world_from_obj: Float[np.ndarray, "instant 4 4"],
) -> Float[np.ndarray, "instant vert"]:
    """Distance of hand vertices to the object's surface, metres, negative inside."""
    verts_obj = verts_in_object(verts_world, T_world_from_obj)
    return surface.distance(verts_obj.reshape(-1, 3)).reshape(verts_world.shape[:2])


def digit_distances(
    model: HandModel, distances_m: Float[np.ndarray, "instant vert"]
) -> Float[np.ndarray, "instant 5"]:
    """Smallest signed distance of each digit (thumb, index, middle, ring, pinky), metres."""
    digit = digit_of_vertex(model)
    return np.stack([distances_m[:, digit == number].min(axis=1) for number in range(len(DIGITS))], axis=1)


def digits_touching(digit_distance_m: Float[np.ndarray, "*instant 5"]) -> Int[np.ndarray, "*instant"]:
    """How many digits touch."""
    return np.asarray((digit_distance_m < TOUCHING_M).sum(axis=-1))
