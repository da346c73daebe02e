"""Skinning weights from the pivots: one rule for every digit.

A digit takes its flesh by a step across the bisecting plane of each of its joints; flesh
between two fingers is shared by distance to their bones. All weights of a vertex sum to one.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from datagen.hands.builders.hand_arrays import (
    HandArrays,
    digit_chain,
    neighbour_mean,
    smoothstep,
)
from shards.joints import DIGIT_JOINTS

__all__ = ["blend_weights"]

# Where the step of each joint begins and ends, metres along the bisector, distal positive.
FINGER_STEPS = ((-0.012, 0.016), (-0.008, 0.008), (-0.007, 0.007))
THUMB_STEPS = ((-0.006, 0.024), (-0.010, 0.010), (-0.009, 0.009))
FINGER_SHARING = 0.006  # metres; neighbours share flesh over about twice this
THENAR_FULL, THENAR_NONE = 0.012, 0.030  # distance to the thumb's bones at which it takes all, nothing
RING_MARGIN = 0.010  # metres from the wrist border over which the wrist takes everything
N_SMOOTHING = 4


def blend_weights(hand: HandArrays) -> HandArrays:
    """Replace the skinning weights by smooth ones around the present pivots."""
    verts = hand.v_template
    thumb = _thumb_share(hand)
    fingers = _finger_shares(hand)
    weights = np.zeros((len(verts), 16))
    for digit, joints in DIGIT_JOINTS.items():
        share = thumb if digit == "thumb" else fingers[digit]
        steps = _joint_steps(hand, digit)
        weights[:, joints[0]] = share * steps[0] * (1.0 - steps[1])
        weights[:, joints[1]] = share * steps[0] * steps[1] * (1.0 - steps[2])
        weights[:, joints[2]] = share * steps[0] * steps[1] * steps[2]
    in_thumb = weights[:, 13:].sum(axis=1, keepdims=True)
    weights[:, 1:13] *= 1.0 - in_thumb
    ring = verts[hand.wrist_loop]
    to_ring = np.linalg.norm(verts[:, None] - ring, axis=2).min(axis=1)
    weights *= smoothstep(to_ring, 0.0, RING_MARGIN)[:, None]
    weights = _smooth(hand, weights)
    weights[:, 0] = np.maximum(1.0 - weights[:, 1:].sum(axis=1), 0.0)  # rounding may leave -2e-16
    return replace(hand, weights=weights)


def _joint_steps(hand: HandArrays, digit: str) -> list[Float[np.ndarray, " vert"]]:
    chain = digit_chain(hand, digit)
    bones = np.diff(chain, axis=0)
    bones /= np.linalg.norm(bones, axis=1, keepdims=True)
    steps = []
    for k, (low, high) in enumerate(THUMB_STEPS if digit == "thumb" else FINGER_STEPS):
        normal = bones[k] + bones[max(k - 1, 0)]
        along = (hand.v_template - chain[k]) @ (normal / np.linalg.norm(normal))
        steps.append(smoothstep(along, low, high))
    return steps


def _finger_shares(hand: HandArrays) -> dict[str, Float[np.ndarray, " vert"]]:
    """Soft partition of the flesh among the four fingers."""
    names = [digit for digit in DIGIT_JOINTS if digit != "thumb"]
    distance = np.stack([_distance_to_bones(hand, name) for name in names], axis=1)
    score = np.exp(-(distance**2 - distance.min(axis=1, keepdims=True) ** 2) / (2.0 * FINGER_SHARING**2))
    # Beyond the webs a finger owns its flesh: the base hand knows which vertices those are.
    owned = np.stack([hand.weights[:, list(DIGIT_JOINTS[name][1:])].sum(axis=1) for name in names], axis=1)
    score = np.where(owned.sum(axis=1, keepdims=True) > 0.02, owned, score)
    score /= score.sum(axis=1, keepdims=True)
    return dict(zip(names, score.T))


def _thumb_share(hand: HandArrays) -> Float[np.ndarray, " vert"]:
    owned = hand.weights[:, 13:].sum(axis=1)
    near = 1.0 - smoothstep(_distance_to_bones(hand, "thumb"), THENAR_FULL, THENAR_NONE)
    in_fingers = hand.weights[:, 1:13].sum(axis=1)
    return np.maximum(owned, near * (1.0 - in_fingers))


def _distance_to_bones(hand: HandArrays, digit: str) -> Float[np.ndarray, " vert"]:
    chain = digit_chain(hand, digit)
    distances = []
    for start, end in pairwise(chain):
        bone = end - start
        t = np.clip((hand.v_template - start) @ bone / (bone @ bone), 0.0, 1.0)
        distances.append(np.linalg.norm(hand.v_template - start - t[:, None] * bone, axis=1))
    return np.min(distances, axis=0)


def _smooth(hand: HandArrays, weights: Float[np.ndarray, "vert 16"]) -> Float[np.ndarray, "vert 16"]:
    mean = neighbour_mean(hand.faces, len(weights))
    for _ in range(N_SMOOTHING):
        weights = 0.5 * weights + 0.5 * (mean @ weights)
        weights[hand.wrist_loop, 1:] = 0.0
    return np.where(weights < 1e-4, 0.0, weights)
