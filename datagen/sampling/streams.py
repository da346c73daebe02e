"""Named random streams: one per concern, so that a new draw in one shifts none of the others."""

from enum import IntEnum

import numpy as np

__all__ = ["Stream", "stream_rng"]


class Stream(IntEnum):
    """Third word of the seed. Numbers are part of the data set's identity: never reuse or renumber them."""

    HAND_SHAPE = 1
    GRASP = 2
    CLIP = 3
    CAMERAS = 4
    LIGHTS = 5
    SKIN = 6
    SLEEVE = 7
    TABLE = 8
    BACKGROUND = 9
    RENDER = 10
    TARGETS = 11
    HAND_SIDE = 12


def stream_rng(dataset_seed: int, motion_index: int, stream: Stream, *parts: int) -> np.random.Generator:
    """Generator of one concern of one motion; `parts` split it further (a camera's number).

    Depends on nothing but its arguments: any motion comes out the same alone, in any order, on any machine.
    """
    return np.random.default_rng(np.random.SeedSequence([dataset_seed, motion_index, int(stream), *parts]))
