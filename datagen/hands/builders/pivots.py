"""Moves the pivots of the base hand to where the joints of a real hand are.

The base hand has its knuckle pivots at the webs of the fingers, some 18 mm too distal, and
its thumb pivot 16 mm too distal. Finger pivots slide along the straight axis of their finger;
the flesh of the finger follows half way at the last joint, whose palmar crease in a real
hand lies proximal to the pivot.
"""

from dataclasses import replace

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.interpolate import PchipInterpolator
from scipy.optimize import minimize

from datagen.hands.builders.anthropometry import SEGMENT_FRACTIONS, hand_length
from datagen.hands.builders.hand_arrays import (
    HandArrays,
    digit_chain,
    fit_regressor_row,
)
from shards.joints import DIGIT_JOINTS, DIGITS

__all__ = ["move_pivots"]

FINGERS = ("index", "middle", "ring", "pinky")
TOLERANCE = 0.035  # largest deviation of a segment from its published fraction that is aimed at
PIVOT_DEPTHS = (0.36, 0.45, 0.45)  # MCP, PIP, DIP: part of the thickness that lies dorsal of the pivot
DIP_FLESH_FOLLOWS = 0.5
WEB_BEHIND_PIP = 0.030  # metres; the flesh of the palm stays
# The saddle joint of the thumb: 15 mm distal of the wrist pivot, radial and a little palmar.
# The length of the metacarpal settles where on the line to it the pivot lies.
THUMB_CMC_SEED = np.array([-0.0170, -0.0060, 0.0180])


def move_pivots(hand: HandArrays) -> HandArrays:
    """New pivots and their regressor for all shapes, and the finger flesh that moves with them."""
    length = hand_length(hand)
    length += _finger_shifts(hand, "middle", length)[3]  # its tip decides the hand length
    shifts = {finger: _finger_shifts(hand, finger, length) for finger in FINGERS}
    warped = hand.v_template.copy()
    for finger in FINGERS:
        warped += _flesh_shift(hand, finger, shifts[finger])
    samples = hand.shape_samples
    old_joints = np.einsum("jv,svc->sjc", hand.J_regressor, samples)
    new_samples = samples + (warped - hand.v_template)
    regressor = hand.J_regressor.copy()
    for finger in FINGERS:
        tips = samples[:, hand.tip_ids[DIGITS.index(finger)]]
        targets = _finger_targets(old_joints[:, list(DIGIT_JOINTS[finger])], tips, shifts[finger])
        axis = targets[1][0] - targets[0][0]
        for joint, target, depth in zip(DIGIT_JOINTS[finger], targets, PIVOT_DEPTHS):
            centred = _centre_of_section(warped, hand.faces, target[0], axis, depth)
            regressor[joint] = fit_regressor_row(new_samples, target + (centred - target[0]))
    regressor[13] = fit_regressor_row(new_samples, _thumb_targets(old_joints, length))
    regressor[0] = fit_regressor_row(new_samples, old_joints[:, 0])
    return replace(hand, v_template=warped, J_regressor=regressor)


def _finger_shifts(hand: HandArrays, finger: str, length: float) -> Float[np.ndarray, "4"]:
    """Distance of the MCP behind the PIP, and distal shifts of PIP, DIP and tip; metres.

    The smallest shifts of PIP, DIP and tip that bring all four segments within TOLERANCE.
    """
    mcp, pip, dip, tip = digit_chain(hand, finger)
    axis = (pip - mcp) / np.linalg.norm(pip - mcp)

    def deviation(x: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4"]:
        chain = np.vstack(
            [hand.joints[0], pip - axis * x[0], pip + axis * x[1], dip + axis * x[2], tip + axis * x[3]]
        )
        return np.linalg.norm(np.diff(chain, axis=0), axis=1) / (length * SEGMENT_FRACTIONS[finger]) - 1.0

    result = minimize(  # type: ignore[call-overload]
        lambda x: 1e6 * (x[1] ** 2 + x[2] ** 2 + 1.5 * x[3] ** 2),
        np.array([0.045, 0.0, 0.0, 0.0]),
        method="SLSQP",
        constraints=[
            {"type": "ineq", "fun": lambda x: TOLERANCE - deviation(x)},
            {"type": "ineq", "fun": lambda x: TOLERANCE + deviation(x)},
        ],
    )
    if not result.success:
        raise ValueError(
            f"{finger}: no pivots within {TOLERANCE:.0%} of the published fractions ({result.message})"
        )
    return result.x


def _flesh_shift(
    hand: HandArrays, finger: str, shifts: Float[np.ndarray, "4"]
) -> Float[np.ndarray, "vert 3"]:
    """Displacement of the finger's flesh along its axis, none at the web."""
    mcp, pip, dip, tip = digit_chain(hand, finger)
    axis = (pip - mcp) / np.linalg.norm(pip - mcp)
    along = (hand.v_template - pip) @ axis
    knots = np.array([-1.0, -WEB_BEHIND_PIP, 0.0, (dip - pip) @ axis, (tip - pip) @ axis, 1.0])
    values = np.array([0.0, 0.0, shifts[1], DIP_FLESH_FOLLOWS * shifts[2], shifts[3], shifts[3]])
    belongs = hand.weights[:, list(DIGIT_JOINTS[finger])].sum(axis=1)
    return (belongs * PchipInterpolator(knots, values)(along))[:, None] * axis


def _finger_targets(
    joints: Float[np.ndarray, "sample 3 3"],
    tips: Float[np.ndarray, "sample 3"],
    shifts: Float[np.ndarray, "4"],
) -> tuple[Float[np.ndarray, "sample 3"], ...]:
    """The new pivots for every sampled shape: fixed ratios of the old bones, so linear in the shape."""
    mcp, pip, dip = joints[:, 0], joints[:, 1], joints[:, 2]
    mean_length = np.linalg.norm([pip[0] - mcp[0], dip[0] - pip[0], tips[0] - dip[0]], axis=1)
    new_mcp = pip - (pip - mcp) * shifts[0] / mean_length[0]
    new_pip = pip + (dip - pip) * shifts[1] / mean_length[1]
    new_dip = dip + (tips - dip) * shifts[2] / mean_length[2]
    return new_mcp, new_pip, new_dip


def _thumb_targets(
    old_joints: Float[np.ndarray, "sample 16 3"], length: float
) -> Float[np.ndarray, "sample 3"]:
    """The saddle joint for every sampled shape: on the line from the thumb's MCP through the seed."""
    wrist, mcp = old_joints[:, 0], old_joints[:, 14]
    direction = THUMB_CMC_SEED - mcp[0]
    offset = direction / np.linalg.norm(direction) * SEGMENT_FRACTIONS["thumb"][0] * length
    # Other shapes: the same point of the triangle wrist, old pivot, MCP, carried affinely.
    corners = np.stack([wrist, old_joints[:, 13], mcp, old_joints[:, 4]], axis=1)
    coordinates = np.linalg.solve(np.vstack([corners[0].T, np.ones(4)]), np.append(mcp[0] + offset, 1.0))
    return np.einsum("k,skc->sc", coordinates, corners)


def _centre_of_section(
    verts: Float[np.ndarray, "vert 3"],
    faces: Int[np.ndarray, "face 3"],
    point: Float[np.ndarray, "3"],
    axis: Float[np.ndarray, "3"],
    depth: float,
) -> Float[np.ndarray, "3"]:
    """Move a pivot to `depth` of the thickness, counted from the back of the hand, square to its bone."""
    across = np.cross(axis, [0.0, 1.0, 0.0])
    dorsal = np.cross(across, axis)
    dorsal /= np.linalg.norm(dorsal)
    mesh = trimesh.Trimesh(verts, faces, process=False)
    hits, rays, _ = mesh.ray.intersects_location([point, point], [dorsal, -dorsal], multiple_hits=False)
    if sorted(rays) != [0, 1]:
        raise ValueError(f"pivot {point}: outside the hand mesh")
    back, palm = hits[rays == 0][0], hits[rays == 1][0]
    return back + depth * (palm - back)
