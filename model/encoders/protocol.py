"""The one interface of everything that turns images into conditioning tokens."""

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["FeatureEncoder"]


@runtime_checkable
class FeatureEncoder(Protocol):
    """Frozen: no gradients reach it, it is always in evaluation mode and never part of a checkpoint.

    Encoders are therefore no `nn.Module`s: what holds one does not register its weights.
    """

    @property
    def grid(self) -> int:
        """Tokens along one side of the image; token r * grid + c covers row r and column c, from the top left."""

    @property
    def channels(self) -> int:
        """Width of a token."""

    def to(self, device: torch.device | str, dtype: torch.dtype) -> "FeatureEncoder":
        """The same encoder with its weights there."""

    def __call__(
        self, images: Float[Tensor, "batch view 3 size size"]
    ) -> Float[Tensor, "batch view token channel"]:
        """Features of sRGB images in 0..1 of any size, in the images' dtype.

        The encoder resizes and normalises by itself. Tokens describe the whole image, so they are
        aligned with it: token r * grid + c is centred at ((c + 0.5), (r + 0.5)) / grid of its sides.
        """
