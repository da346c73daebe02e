"""A ShardStream as the trainer wants it: from any point on, with places in the global batch."""

from collections.abc import Iterator
from dataclasses import dataclass

from model.data import ShardStream, StreamConfig, StreamState
from model.motion_index import MotionIndex
from model.training.trainer import PlacedBatch

__all__ = ["StreamSource"]


@dataclass(frozen=True, kw_only=True)
class StreamSource:
    """Batches of one rank; a `BatchSource`."""

    config: StreamConfig  # endless
    index: MotionIndex
    rank: int
    ranks: int

    def batches(self, epoch: int, samples_consumed: int) -> Iterator[PlacedBatch]:
        """Endless batches from there on. Loader processes end with the iterator."""
        state = StreamState(epoch=epoch, consumed=samples_consumed)
        stream = ShardStream(
            self.config, rank=self.rank, world_size=self.ranks, state=state, index=self.index
        )
        first = self.config.batch_size * self.rank // self.ranks
        try:
            for batch in stream:
                yield PlacedBatch(
                    batch=batch,
                    places=range(first, first + len(batch.ids)),
                    epoch=stream.state.epoch,
                    samples_consumed=stream.state.consumed,
                )
        finally:
            stream.close()
