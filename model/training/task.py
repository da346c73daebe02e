"""What can be trained: the trainer knows nothing of networks, a Task nothing of optimisers."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import UInt8
from torch import nn

from model.sample import Batch

__all__ = ["Evaluation", "Losses", "Task"]


@dataclass(frozen=True, kw_only=True)
class Losses:
    """The loss that is minimised, a mean over the samples of the batch, and its parts for the log."""

    total: torch.Tensor
    parts: dict[str, torch.Tensor]


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Figures and pictures of a validation run. `better` names figures of which more is better."""

    figures: dict[str, float]
    pictures: dict[str, UInt8[np.ndarray, "height width 3"]]


@runtime_checkable
class Task(Protocol):
    """One thing to train."""

    @property
    def module(self) -> nn.Module:
        """Everything that has parameters to train; frozen parts may be inside or outside."""

    def loss(self, batch: Batch, generators: Sequence[torch.Generator]) -> Losses:
        """Loss of a batch. All randomness comes from the generators, one per sample (`draws.py`)."""

    def evaluate(self, batches: Iterable[Batch]) -> Evaluation:
        """Figures with the weights that the module holds now; no gradients, randomness of its own fixed seed."""
