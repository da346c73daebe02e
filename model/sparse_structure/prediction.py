"""Prediction: what stage 1 gives to whoever comes after it."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

__all__ = ["Prediction"]


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """What stage 1 finds in a batch of views."""

    occupancy: Bool[Tensor, "batch 64 64 64"]
    masks: Float[Tensor, "batch view m m"]  # amodal object mask: above 0 inside
