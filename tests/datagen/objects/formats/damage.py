"""A file damaged at every byte: cut there, or with another byte in its place."""

from collections.abc import Callable, Iterator

import numpy as np

from datagen.objects.errors import ObjectError


def damaged(whole: bytes) -> Iterator[bytes]:
    rng = np.random.default_rng(0)
    for at in range(len(whole)):
        yield whole[:at]
        yield whole[:at] + rng.bytes(1) + whole[at + 1 :]


def refusals(whole: bytes, read: Callable[[bytes], object]) -> int:
    """How many of the damaged files are refused; the others are read. Any other error is let through."""
    refused = 0
    for data in damaged(whole):
        try:
            read(data)
        except ObjectError:
            refused += 1
    return refused
