"""The order: each sample once per epoch, the same whatever the number of ranks."""

from itertools import islice

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.data.order import RandomStream, StreamState, epoch_order, random_stream, rank_batches

START = StreamState(epoch=0, consumed=0)


def batches(rank=0, world_size=1, state=START, *, motions=7, per_motion=3, batch_size=6, endless=True):
    return rank_batches(
        state,
        n_motions=motions,
        samples_per_motion=per_motion,
        batch_size=batch_size,
        views=(2, 6),
        seed=3,
        rank=rank,
        world_size=world_size,
        endless=endless,
    )


@settings(max_examples=40)
@given(
    motions=st.integers(1, 20),
    per_motion=st.integers(1, 3),
    world_size=st.integers(1, 4),
    local=st.integers(1, 3),
)
def test_every_rank_count_gives_the_same_batches_and_each_sample_once(motions, per_motion, world_size, local):
    sizes = {"motions": motions, "per_motion": per_motion, "batch_size": world_size * local}
    n_samples = motions * per_motion
    n_batches = -(-3 * n_samples // sizes["batch_size"])
    alone = [keys for keys, _ in islice(batches(**sizes), n_batches)]
    parts = [
        [keys for keys, _ in islice(batches(r, world_size, **sizes), n_batches)] for r in range(world_size)
    ]
    assert [sum(local_keys, ()) for local_keys in zip(*parts)] == alone
    assert all(len(keys) == local for part in parts for keys in part)
    for epoch in range(2):
        seen = [key for keys in alone for key in keys if key.epoch == epoch]
        assert sorted(key.position for key in seen) == list(range(n_samples))
        assert sorted(key.item for key in seen) == sorted(list(range(motions)) * per_motion)
    assert all(len({key.n_views for key in keys}) == 1 for keys in alone)


@pytest.mark.parametrize("stop", [1, 3, 4, 9])
def test_continuing_from_a_state_changes_nothing_also_on_another_number_of_ranks(stop):
    whole = list(islice(batches(), 14))
    state = whole[stop - 1][1]
    assert list(islice(batches(state=state), 14 - stop)) == whole[stop:]
    two = [list(islice(batches(rank, 2, state), 2)) for rank in range(2)]
    joined = [a + b for (a, _), (b, _) in zip(*two)]
    assert joined == [keys for keys, _ in whole[stop : stop + 2]]
    assert two[0][-1][1] == two[1][-1][1] == whole[stop + 1][1]
    assert list(islice(batches(state=two[0][-1][1]), 12 - stop)) == whole[stop + 2 :]


def test_state_counts_samples_of_all_ranks_and_wraps_at_the_end_of_the_epoch():
    states = [state for _, state in islice(batches(motions=2, per_motion=3, batch_size=4), 3)]
    expected = [(0, 4), (1, 2), (2, 0)]
    assert [(state.epoch, state.consumed) for state in states] == expected


def test_one_pass_is_in_file_order_and_ends():
    keys = [keys for keys, _ in batches(per_motion=1, batch_size=3, endless=False)]
    assert [[key.item for key in batch] for batch in keys] == [[0, 1, 2], [3, 4, 5], [6]]
    parts = [[k for k, _ in batches(r, 2, per_motion=1, batch_size=3, endless=False)] for r in range(2)]
    assert [a + b for a, b in zip(*parts)] == keys


def test_epochs_and_seeds_have_orders_of_their_own():
    orders = [
        tuple(epoch_order(50, seed=seed, epoch=epoch, shuffle=True)) for seed in (0, 1) for epoch in (0, 1)
    ]
    assert len(set(orders)) == 4
    assert orders[0] == tuple(epoch_order(50, seed=0, epoch=0, shuffle=True))


def test_random_streams_are_distinct():
    """SeedSequence pads with zeros, so keys of different length could be the same stream."""
    draws = [
        random_stream(1, epoch, position, stream, attempt).random()
        for epoch in (0, 1)
        for position in (0, 1)
        for stream in RandomStream
        for attempt in (0, 1)
    ]
    assert len(np.unique(draws)) == len(draws)


def test_views_per_batch_cover_the_range():
    counts = {keys[0].n_views for keys, _ in islice(batches(), 60)}
    assert counts == {2, 3, 4, 5, 6}
