"""Which sample comes when: a pure function of (seed, epoch, position), the same on any number of ranks.

The samples of all epochs form one endless line; epoch e is a permutation of its own. A global batch is
the next `batch_size` samples of that line (it may reach into the next epoch, so batches are always
full), and rank r of n takes the r-th n-th of it. Hence the state is one place in the line, and
concatenating the ranks gives the batch of a single process.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Int

__all__ = ["RandomStream", "SampleKey", "StreamState", "epoch_order", "random_stream", "rank_batches"]


class RandomStream(IntEnum):
    """Last word of the seed: what the numbers are for."""

    ORDER = 1
    VIEW_COUNT = 2
    VIEWS = 3
    CROP = 4


@dataclass(frozen=True, kw_only=True)
class StreamState:
    """Place in the line: the epoch, and how many of its samples all ranks together have consumed."""

    epoch: int
    consumed: int


@dataclass(frozen=True, kw_only=True)
class SampleKey:
    """One sample: `item` is the number of the motion, `position` its place in the epoch."""

    epoch: int
    position: int
    item: int
    n_views: int


def random_stream(
    seed: int, epoch: int, position: int, stream: RandomStream, attempt: int = 0
) -> np.random.Generator:
    """The numbers of one sample, whoever computes it. `attempt` counts samples given up as corrupt."""
    words = [seed, epoch, position, int(stream)]  # four: SeedSequence pads shorter ones with zeros
    return np.random.default_rng(np.random.SeedSequence([*words, attempt] if attempt else words))


def epoch_order(n_samples: int, *, seed: int, epoch: int, shuffle: bool) -> Int[np.ndarray, " sample"]:
    """Sample at each position of the epoch."""
    if not shuffle:
        return np.arange(n_samples)
    return random_stream(seed, epoch, 0, RandomStream.ORDER).permutation(n_samples)


def rank_batches(
    state: StreamState,
    *,
    n_motions: int,
    samples_per_motion: int,
    batch_size: int,
    views: tuple[int, int],
    seed: int,
    rank: int,
    world_size: int,
    endless: bool,
) -> Iterator[tuple[tuple[SampleKey, ...], StreamState]]:
    """This rank's part of every batch from `state` on, with the state after the batch.

    Endless: shuffled epochs without end. Otherwise: what is left of this epoch, in file order; its
    last batch may be short, and then some ranks may get an empty part.
    """
    n_samples = n_motions * samples_per_motion
    epoch, consumed = state.epoch, state.consumed
    order = epoch_order(n_samples, seed=seed, epoch=epoch, shuffle=endless)
    while endless or consumed < n_samples:
        first = random_stream(seed, epoch, consumed, RandomStream.VIEW_COUNT)
        n_views = int(first.integers(views[0], views[1] + 1))
        batch: list[SampleKey] = []
        while len(batch) < batch_size:
            if consumed == n_samples:
                if not endless:
                    break
                epoch, consumed = epoch + 1, 0
                order = epoch_order(n_samples, seed=seed, epoch=epoch, shuffle=True)
            item = int(order[consumed]) % n_motions
            batch.append(SampleKey(epoch=epoch, position=consumed, item=item, n_views=n_views))
            consumed += 1
        if endless and consumed == n_samples:
            epoch, consumed = epoch + 1, 0
            order = epoch_order(n_samples, seed=seed, epoch=epoch, shuffle=True)
        start, stop = (len(batch) * r // world_size for r in (rank, rank + 1))
        yield tuple(batch[start:stop]), StreamState(epoch=epoch, consumed=consumed)
