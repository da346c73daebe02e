"""A ShardStream as the trainer wants it: from any point on, with places in the global batch."""

from collections.abc import Generator
from dataclasses import dataclass

from model.data.index import MotionIndex
from model.data.stream import ShardStream, StreamConfig, StreamState
from model.recipes.components.component_identity import sha256_of
from model.training.trainer import PlacedBatch

__all__ = ["StreamSource"]


@dataclass(frozen=True, kw_only=True)
class StreamSource:
    """Batches of one rank; a `BatchSource`."""

    config: StreamConfig  # endless
    index: MotionIndex
    rank: int
    ranks: int

    @property
    def data_sha256(self) -> str:
        """Of all shards in their order, by what their records say of their files: the same wherever they lie."""
        files = [shard.record.files for shard in self.index.shards]
        return sha256_of(*(of_shard[name].sha256 for of_shard in files for name in sorted(of_shard)))

    def batches(self, epoch: int, samples_consumed: int) -> Generator[PlacedBatch, None, None]:
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
