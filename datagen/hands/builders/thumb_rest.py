"""Turns the resting thumb into the palm plane, where MANO's mean hand has it.

The base hand was sampled with the thumb hanging 30 degrees below the palm. Axis-angle poses are
relative to the rest hand, so the rest direction decides where recorded MANO angles take the thumb.
Every vertex turns by its own share of the angle: an arc instead of a chord, so nothing shrinks.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from datagen.hands.builders.hand_arrays import HandArrays, fit_regressor_row, neighbour_mean, rotate_about

__all__ = ["raise_thumb"]

TARGET_HEIGHT = -0.008  # of the thumb's last pivot relative to the wrist pivot, metres (MANO: about -0.014)
N_SMOOTHING = 3


def raise_thumb(hand: HandArrays) -> HandArrays:
    """Rest thumb turned about its first pivot, for all shapes alike."""
    share = hand.weights[:, 13:].sum(axis=1)
    axis, angle_rad = _raising_rotation(hand)
    samples, joints = hand.shape_samples, np.einsum("jv,svc->sjc", hand.J_regressor, hand.shape_samples)
    turned = np.empty_like(samples)
    turned_joints = joints.copy()
    for k, pivot in enumerate(joints[:, 13]):
        turned[k] = pivot + rotate_about(axis, share * angle_rad, samples[k] - pivot)
        turned_joints[k, 14:] = pivot + rotate_about(axis, np.full(2, angle_rad), joints[k, 14:] - pivot)
    turned = _smooth_blend(hand, share, turned)
    regressor = hand.J_regressor.copy()
    for joint in range(16):
        regressor[joint] = fit_regressor_row(turned, turned_joints[:, joint])
    return replace(
        hand,
        v_template=turned[0],
        shapedirs=np.moveaxis(turned[1:] - turned[0], 0, 2),
        J_regressor=regressor,
    )


def _raising_rotation(hand: HandArrays) -> tuple[Float[np.ndarray, "3"], float]:
    """Unit axis in the palm plane and angle that bring the last pivot to its height."""
    wrist, pivot, last = hand.joints[[0, 13, 15]]
    reach = last - pivot
    heading = np.array([reach[0], 0.0, reach[2]])
    axis = np.cross(heading, [0.0, 1.0, 0.0])
    axis /= np.linalg.norm(axis)
    present = np.arctan2(reach[1], np.linalg.norm(heading))
    wanted = np.arcsin((wrist[1] + TARGET_HEIGHT - pivot[1]) / np.linalg.norm(reach))
    return axis, float(wanted - present)


def _smooth_blend(
    hand: HandArrays, share: Float[np.ndarray, " vert"], samples: Float[np.ndarray, "sample vert 3"]
) -> Float[np.ndarray, "sample vert 3"]:
    """Relax the turned part of the flesh, without shrinking it: one step in, one step out (Taubin)."""
    mean = neighbour_mean(hand.faces, len(share))
    blend = (4.0 * share * (1.0 - share))[:, None]
    relaxed = samples.copy()
    for k in range(len(relaxed)):
        for _ in range(N_SMOOTHING):
            for step in (0.5, -0.52):
                relaxed[k] += step * blend * (mean @ relaxed[k] - relaxed[k])
    return relaxed
