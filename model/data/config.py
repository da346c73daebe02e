"""StreamConfig: which data a stream reads, in what order, and how it varies them."""

from dataclasses import dataclass, replace
from typing import Literal

from model.data.crop import Augmentation
from model.errors import ModelError
from shards.splits import Split

__all__ = ["Cameras", "StreamConfig", "validation_config"]

Cameras = Literal["all", "train", "held_out"]


@dataclass(frozen=True, kw_only=True)
class StreamConfig:
    """Everything that decides the batches of a stream, and how they are loaded."""

    datasets: tuple[str, ...]  # folders or fsspec URLs of datasets, or of single shards (".../shard-00000")
    split: Split
    cameras: Cameras
    held_out_cameras: float  # share of the cameras of each motion, the last by index, that is held out
    seed: int
    batch_size: int  # over all ranks
    views: tuple[int, int]  # fewest and most; drawn per batch
    image_size: int  # px, side of the square crops
    augmentation: Augmentation
    samples_per_motion: int  # per epoch, each with its own views
    endless: bool  # True: shuffled epochs without end; False: one pass in file order, the same every time
    workers: int  # loader processes; 0 loads in the calling process
    prefetch_batches: int  # per worker
    cache_mb: int  # of encoded clips, per worker
    on_corrupt: Literal["raise", "skip"]  # skip: another sample takes the place, the row is counted
    max_corrupt: int  # distinct corrupt rows before a stream that skips gives up
    # Also read the objects' surface samples. What is trained decides it, not the user: hence the default.
    surface: bool = False

    def __post_init__(self) -> None:
        checks = (
            ("datasets", len(self.datasets) > 0, self.datasets, "at least one"),
            ("held_out_cameras", 0.0 < self.held_out_cameras < 1.0, self.held_out_cameras, "between 0 and 1"),
            ("seed", self.seed >= 0, self.seed, ">= 0"),
            ("batch_size", self.batch_size > 0, self.batch_size, "> 0"),
            ("views", 0 < self.views[0] <= self.views[1], self.views, "1 <= fewest <= most"),
            ("image_size", self.image_size > 0, self.image_size, "> 0"),
            ("samples_per_motion", self.samples_per_motion > 0, self.samples_per_motion, "> 0"),
            ("workers", self.workers >= 0, self.workers, ">= 0"),
            ("prefetch_batches", self.prefetch_batches > 0, self.prefetch_batches, "> 0"),
            ("cache_mb", self.cache_mb >= 0, self.cache_mb, ">= 0"),
            ("max_corrupt", self.max_corrupt >= 0, self.max_corrupt, ">= 0"),
        )
        for name, good, found, expected in checks:
            if not good:
                raise ModelError(
                    f"data.{name}", f"{found} is not usable", expected=expected, action="Change it."
                )


def validation_config(
    training: StreamConfig, *, split: Split, cameras: Cameras, views: int, batch_size: int
) -> StreamConfig:
    """One pass over other data of the same datasets: fixed views, nothing varied."""
    return replace(
        training,
        split=split,
        cameras=cameras,
        views=(views, views),
        batch_size=batch_size,
        samples_per_motion=1,
        endless=False,
        augmentation=training.augmentation.switched_off(),
    )
