"""Joint centres of a MakeHuman hand, moved to where anatomy has them.

MakeHuman's knuckle pivots sit at the webs between the fingers, some 17 mm too far from the wrist, and
all its finger pivots lie near the back of the finger. Knuckles and the root of the thumb take the
distances that Buchholz et al. (1992) give as fractions of hand length; the other finger joints keep
their creases and move to the middle of the finger.
"""

import numpy as np
import trimesh
from jaxtyping import Float, Int
from trimesh.ray.ray_pyembree import RayMeshIntersector

__all__ = ["BUCHHOLZ", "CHAINS", "canonical_frame", "joint_centers", "tip_vertices"]

# wrist-knuckle, proximal, middle, distal; thumb: metacarpal, proximal, distal. Fractions of hand length.
BUCHHOLZ = {
    "index": (0.463, 0.245, 0.143, 0.097),
    "middle": (0.446, 0.266, 0.170, 0.108),
    "pinky": (0.414, 0.204, 0.117, 0.093),
    "ring": (0.421, 0.244, 0.165, 0.107),
    "thumb": (0.251, 0.196, 0.158),
}
CHAINS = {"index": 1, "middle": 4, "pinky": 7, "ring": 10, "thumb": 13}  # first joint of each digit
_KNUCKLE_DEPTH = 0.40  # of the thickness, from the back of the hand
_FINGER_DEPTH = 0.46
# Direction of the thumb's metacarpal seen from its head: back towards the trapezium bone.
_TRAPEZIUM_FRACTION = np.array([-0.085, -0.035, 0.105])  # of hand length, from the wrist joint


def canonical_frame(joints: Float[np.ndarray, "16 3"]) -> Float[np.ndarray, "3 3"]:
    """Rows: -x along wrist to middle knuckle, +y out of the back of the hand, +z to the thumb."""
    x = joints[0] - joints[4]
    x /= np.linalg.norm(x)
    z = joints[1] - joints[7]
    z -= x * (z @ x)
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z])


def tip_vertices(
    verts: Float[np.ndarray, "vert 3"], joints: Float[np.ndarray, "16 3"], digits: dict[str, Float[np.ndarray, "vert"]]
) -> dict[str, int]:
    """The vertex farthest along each digit's last bone."""
    tips = {}
    for digit, first in CHAINS.items():
        along = joints[first + 2] - joints[first + 1]
        reach = np.where(digits[digit] > 0.9, (verts - joints[first + 2]) @ along, -np.inf)
        tips[digit] = int(reach.argmax())
    return tips


def joint_centers(
    verts: Float[np.ndarray, "vert 3"],
    faces: Int[np.ndarray, "face 3"],
    joints: Float[np.ndarray, "16 3"],
    tips: dict[str, int],
) -> Float[np.ndarray, "16 3"]:
    """Corrected joints, in the canonical frame the arguments are in."""
    caster = RayMeshIntersector(trimesh.Trimesh(verts, faces, process=False))
    result = joints.copy()
    length = _hand_length(joints, verts[tips["middle"]])
    for digit, first in CHAINS.items():
        if digit == "thumb":
            continue
        for k in (first + 1, first + 2):
            along = verts[tips[digit]] - joints[k - 1]
            result[k] = _centered(caster, joints[k], along, _FINGER_DEPTH)
        # The knuckle lies on the line from the wrist to the finger's base, at Buchholz's distance.
        metacarpal = joints[first] - joints[0]
        knuckle = joints[0] + metacarpal * (BUCHHOLZ[digit][0] * length / np.linalg.norm(metacarpal))
        knuckle = _dorsal_depth(caster, knuckle, _KNUCKLE_DEPTH)
        result[first] = joints[0] + (knuckle - joints[0]) * (
            BUCHHOLZ[digit][0] * length / np.linalg.norm(knuckle - joints[0])
        )
    thumb = CHAINS["thumb"]
    toward = joints[0] + _TRAPEZIUM_FRACTION * length - joints[thumb + 1]
    result[thumb] = joints[thumb + 1] + toward * (BUCHHOLZ["thumb"][0] * length / np.linalg.norm(toward))
    return result


def _hand_length(joints: Float[np.ndarray, "16 3"], middle_tip: Float[np.ndarray, "3"]) -> float:
    """Wrist to middle fingertip with the finger straightened."""
    chain = np.stack([joints[0], joints[4], joints[5], joints[6], middle_tip])
    return float(np.linalg.norm(np.diff(chain, axis=0), axis=1).sum())


def _centered(
    caster: RayMeshIntersector, point: Float[np.ndarray, "3"], along: Float[np.ndarray, "3"], depth: float
) -> Float[np.ndarray, "3"]:
    """Middle of the finger across, `depth` of its thickness below the back, in the section square to `along`."""
    along = along / np.linalg.norm(along)
    side = np.cross(along, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    back = np.cross(side, along)
    high, low = _exits(caster, point, back)
    middle = high + 0.5 * (low - high)
    left, right = _exits(caster, middle, side)
    centered = point + side * ((0.5 * (left + right) - point) @ side)
    high, low = _exits(caster, centered, back)
    return high + depth * (low - high)


def _dorsal_depth(caster: RayMeshIntersector, point: Float[np.ndarray, "3"], depth: float) -> Float[np.ndarray, "3"]:
    high, low = _exits(caster, point, np.array([0.0, 1.0, 0.0]))
    return high + depth * (low - high)


def _exits(
    caster: RayMeshIntersector, point: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Where a line leaves the mesh forward and backward of an inner point."""
    location, ray, _ = caster.intersects_location(
        np.stack([point, point]), np.stack([direction, -direction]), multiple_hits=False
    )
    if len(location) < 2:
        raise ValueError(f"joint centre {point}: outside the hand mesh")
    return location[ray == 0][0], location[ray == 1][0]
