"""Lengths of the hand's segments, as fractions of hand length.

Source: Buchholz, Armstrong and Goldstein, "Anthropometric data for describing the kinematics
of the human hand", Ergonomics 35(3), 1992. Hand length is wrist to middle fingertip.
"""

import numpy as np
from jaxtyping import Float

from datagen.hands.builders.hand_arrays import HandArrays, digit_chain

__all__ = ["SEGMENT_FRACTIONS", "hand_length", "segment_deviation", "segment_lengths"]

# Fingers: wrist-MCP, MCP-PIP, PIP-DIP, DIP-tip. Thumb: CMC-MCP, MCP-IP, IP-tip.
SEGMENT_FRACTIONS = {
    "thumb": np.array([0.251, 0.196, 0.158]),
    "index": np.array([0.463, 0.245, 0.143, 0.097]),
    "middle": np.array([0.446, 0.266, 0.170, 0.108]),
    "ring": np.array([0.421, 0.244, 0.165, 0.107]),
    "pinky": np.array([0.414, 0.204, 0.117, 0.093]),
}


def hand_length(hand: HandArrays) -> float:
    """Wrist pivot to middle fingertip, metres."""
    return float(np.linalg.norm(digit_chain(hand, "middle")[3] - hand.joints[0]))


def segment_lengths(hand: HandArrays, digit: str) -> Float[np.ndarray, " segment"]:
    """Lengths of a digit's segments in the order of SEGMENT_FRACTIONS, metres."""
    chain = digit_chain(hand, digit)
    if digit != "thumb":
        chain = np.vstack([hand.joints[:1], chain])
    return np.linalg.norm(np.diff(chain, axis=0), axis=1)


def segment_deviation(hand: HandArrays, digit: str) -> Float[np.ndarray, " segment"]:
    """Relative deviation of each segment from the published fraction (0.05 = 5 % too long)."""
    return segment_lengths(hand, digit) / (hand_length(hand) * SEGMENT_FRACTIONS[digit]) - 1.0
