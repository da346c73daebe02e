"""The streams that one component is trained and measured on."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

import torch
from accelerate import Accelerator

from model.data.batch import Batch
from model.data.config import DataConfig, StreamConfig
from model.data.stream import ShardStream, open_motions, validation_config
from model.recipes.components.recipe import Recipe, ValidationConfig
from model.recipes.components.shard_source import StreamSource

__all__ = ["ComponentData", "component_data"]


@dataclass(frozen=True, kw_only=True)
class ComponentData:
    """Streams of one component."""

    training: StreamSource
    held_out: StreamConfig
    held_out_batches: int  # at most

    def validation(self, device: torch.device, rank: int = 0, ranks: int = 1) -> Iterator[Batch]:
        """The same held-out views every time: every `ranks`-th batch from `rank` on. Each rank reads them all."""
        stream = ShardStream(self.held_out)
        try:
            for batch in islice(stream, rank, self.held_out_batches, ranks):
                yield batch.to(device, torch.float32)
        finally:
            stream.close()

    def each_motion_once(self, batch_size: int) -> ShardStream:
        """The training motions once each, as they are: for what is measured on their objects."""
        stream = self.training.config
        once = validation_config(
            stream, split=stream.split, cameras=stream.cameras, views=1, batch_size=batch_size
        )
        return ShardStream(replace(once, image_size=32, workers=0), index=self.training.index)


def component_data(
    data: DataConfig, validation: ValidationConfig, recipe: Recipe, accelerator: Accelerator, *, surface: bool
) -> ComponentData:
    """Streams with the sizes of `recipe`; `surface`: with the objects' surface samples. ModelError, ShardError."""
    stream = recipe.stream(data, surface=surface)
    held_out = validation_config(
        stream,
        split=validation.split,
        cameras="held_out" if validation.split == stream.split else "all",
        views=validation.views,
        batch_size=validation.batch_size,
    )
    return ComponentData(
        training=StreamSource(
            config=stream,
            index=open_motions(stream),
            rank=accelerator.process_index,
            ranks=accelerator.num_processes,
        ),
        held_out=replace(held_out, workers=0, samples_per_motion=validation.samples_per_motion),
        held_out_batches=validation.batches,
    )
