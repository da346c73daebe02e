"""What can be trained: the trainer knows nothing of networks, a Task nothing of optimisers."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import UInt8
from torch import nn

from model.data.batch import Batch

__all__ = ["Evaluation", "Losses", "Measurements", "SharedValidation", "Task"]


@dataclass(frozen=True, kw_only=True)
class Losses:
    """The loss that is minimised, a mean over the samples of the batch, and its parts for the log."""

    total: torch.Tensor
    parts: dict[str, torch.Tensor]


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Metrics and images of a validation run. A metric that nothing was there for is NaN."""

    metrics: dict[str, float]
    images: dict[str, UInt8[np.ndarray, "height width 3"]]


@dataclass(frozen=True, kw_only=True)
class Measurements:
    """What was found on some of the validation batches: numbers whose means are the metrics, images of the first."""

    numbers: dict[str, list[float]]
    images: dict[str, UInt8[np.ndarray, "height width 3"]]

    def evaluation(self) -> Evaluation:
        """The means, which do not depend on the order of the numbers."""
        means = {
            name: math.fsum(values) / len(values) if values else math.nan
            for name, values in self.numbers.items()
        }
        return Evaluation(metrics=means, images=self.images)


@runtime_checkable
class Task(Protocol):
    """One thing to train."""

    @property
    def module(self) -> nn.Module:
        """Everything that has parameters to train; frozen parts may be inside or outside."""

    def loss(self, batch: Batch, generators: Sequence[torch.Generator]) -> Losses:
        """Loss of a batch. All randomness comes from the generators, one per sample (`step_generators.py`)."""

    def evaluate(self, batches: Iterable[Batch]) -> Evaluation:
        """Metrics with the weights that the module holds now; no gradients, randomness of its own fixed seed."""


@runtime_checkable
class SharedValidation(Protocol):
    """A Task whose validation ranks share: each measures some batches, and the metrics are means over all of them."""

    def measure(self, batches: Iterable[Batch]) -> Measurements:
        """Numbers of every metric, which depend on their batch alone; as for `evaluate`, which gives their means."""
