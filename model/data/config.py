"""DataConfig: which data a training reads. StreamConfig: the batches that a stream makes of them."""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

from model.data.crop import Augmentation
from model.errors import ModelError
from shards.settings import Range
from shards.splits import Split

__all__ = ["Cameras", "DataConfig", "StreamConfig", "validation_config"]

Cameras = Literal["all", "train", "held_out"]


@dataclass(frozen=True, kw_only=True)
class DataConfig:
    """The data that all components of a training share, how they are varied, and how they are loaded."""

    datasets: tuple[str, ...]  # folders or fsspec URLs of datasets, or of single shards (".../shard-00000")
    split: Split
    # share of each motion's cameras, the last by index, that is never trained on
    held_out_cameras: Annotated[float, Range(0, 1)]
    seed: Annotated[int, Range(0, 2**63 - 1)]
    augmentation: Augmentation
    samples_per_motion: Annotated[int, Range(1, 1_000_000_000)]  # per epoch, each with its own views
    workers: Annotated[int, Range(0, 1024)]  # loader processes; 0 loads in the calling process
    prefetch_batches: Annotated[int, Range(1, 10_000)]  # per worker
    cache_mb: Annotated[int, Range(0, 10_000_000)]  # of encoded clips, per worker
    # distinct corrupt rows that others take the place of; 0: the first one is an error
    max_corrupt: Annotated[int, Range(0, 1_000_000_000)]

    def __post_init__(self) -> None:
        _check(
            "data.",
            ("datasets", len(self.datasets) > 0, self.datasets, "at least one"),
            ("held_out_cameras", 0.0 <= self.held_out_cameras < 1.0, self.held_out_cameras, "0 <= share < 1"),
            ("seed", self.seed >= 0, self.seed, ">= 0"),
            ("samples_per_motion", self.samples_per_motion > 0, self.samples_per_motion, "> 0"),
            ("workers", self.workers >= 0, self.workers, ">= 0"),
            ("prefetch_batches", self.prefetch_batches > 0, self.prefetch_batches, "> 0"),
            ("cache_mb", self.cache_mb >= 0, self.cache_mb, ">= 0"),
            ("max_corrupt", self.max_corrupt >= 0, self.max_corrupt, ">= 0"),
        )


@dataclass(frozen=True, kw_only=True)
class StreamConfig(DataConfig):
    """Everything that decides the batches of a stream, and how they are loaded."""

    cameras: Cameras  # "train": those that are not held out
    batch_size: int  # over all ranks
    views: tuple[int, int]  # fewest and most; drawn per batch
    image_size: int  # px, side of the square crops
    endless: bool  # True: shuffled epochs without end; False: one pass in file order, the same every time
    surface: bool = False  # also read the objects' surface samples

    def __post_init__(self) -> None:
        super().__post_init__()
        _check(
            "stream.",
            ("batch_size", self.batch_size > 0, self.batch_size, "> 0"),
            ("views", 0 < self.views[0] <= self.views[1], self.views, "1 <= fewest <= most"),
            ("image_size", self.image_size > 0, self.image_size, "> 0"),
        )


def _check(section: str, *checks: tuple[str, bool, object, str]) -> None:
    """(key, whether it is usable, what it is, what is expected) each. ModelError for the first that is not."""
    for name, good, found, expected in checks:
        if not good:
            raise ModelError(
                f"{section}{name}", f"{found} is not usable", expected=expected, action="Change it."
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
