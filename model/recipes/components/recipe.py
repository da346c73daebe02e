"""How a component is trained and measured on the shared data."""

from dataclasses import dataclass, replace
from typing import Annotated

from model.data.config import DataConfig, StreamConfig
from model.training.config import OptimizerConfig, TrainerConfig
from shards.settings import Range
from shards.splits import Split

__all__ = ["ImageRecipe", "Recipe", "ValidationConfig", "require_held_out"]

_UNSEEN_IMAGE_PX = 32  # a stream reads one image at least; here nobody looks at it


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How a component is trained that learns from shapes alone."""

    trainer: TrainerConfig
    optimizer: OptimizerConfig
    batch_size: Annotated[int, Range(1, 1_000_000)]  # over all ranks

    def __post_init__(self) -> None:
        if self.batch_size < 1:
            raise ValueError(f"batch_size is {self.batch_size}: expected at least 1")

    def stream(self, data: DataConfig, *, surface: bool) -> StreamConfig:
        """Endless batches of the training data; `surface`: with the objects' surface samples."""
        return StreamConfig(
            **vars(data),
            cameras="train",
            batch_size=self.batch_size,
            views=(1, 1),
            image_size=_UNSEEN_IMAGE_PX,
            endless=True,
            surface=surface,
        )


@dataclass(frozen=True, kw_only=True)
class ImageRecipe(Recipe):
    """How a component is trained that looks at images."""

    views: Annotated[tuple[int, int], Range(1, 1000, rising=True)]  # fewest and most of a sample
    image_size: Annotated[int, Range(8, 8192)]  # px

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.views[0] <= self.views[1]:
            raise ValueError(f"views is {list(self.views)}: expected [fewest, most], at least 1")
        if self.image_size < 1:
            raise ValueError(f"image_size is {self.image_size}: expected at least 1")

    def stream(self, data: DataConfig, *, surface: bool) -> StreamConfig:
        """The same with the views and the image size of this recipe."""
        stream = super().stream(data, surface=surface)
        return replace(stream, views=self.views, image_size=self.image_size)


@dataclass(frozen=True, kw_only=True)
class ValidationConfig:
    """What the metrics while training are measured on.

    `split`: that of the training for held-out cameras of its motions, another one for all cameras of objects
    that were never trained on.
    """

    split: Split
    views: Annotated[int, Range(1, 1000)]
    batch_size: Annotated[int, Range(1, 100_000)]
    samples_per_motion: Annotated[int, Range(1, 1_000_000)]  # each with its own views
    batches: Annotated[int, Range(1, 1_000_000)]  # at most

    def __post_init__(self) -> None:
        if min(self.views, self.batch_size, self.samples_per_motion, self.batches) < 1:
            raise ValueError(f"a number in {self} is below 1: expected at least one of each")


def require_held_out(data: DataConfig, validation: ValidationConfig) -> None:
    """ValueError: metrics on what is trained on."""
    if validation.split == data.split and data.held_out_cameras == 0:
        raise ValueError(
            "validation.split is that of the training and data.held_out_cameras is 0: expected a share of the cameras "
            "above 0, so that metrics are of cameras that were not trained on, or another split"
        )
