"""What can be trained: the trainer knows nothing of networks, a Task nothing of optimisers."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import UInt8
from torch import nn

from model.data.batch import Batch

__all__ = ["Evaluation", "Losses", "Measurements", "Task", "merged"]


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
    """Numbers whose means are the metrics, measured on some of the validation batches, and images of the first.

    `numbers`, by metric: of samples, views or joints, each of which is in one batch alone.
    `of_objects`, by metric and object: an object counts once, however many batches show it and whoever measured them.
    """

    numbers: dict[str, list[float]]
    of_objects: dict[str, dict[str, float]] = field(default_factory=dict)
    images: dict[str, UInt8[np.ndarray, "height width 3"]]

    def evaluation(self) -> Evaluation:
        """The means, which do not depend on the order of the numbers; NaN where there is none."""
        values = self.numbers | {name: list(of.values()) for name, of in self.of_objects.items()}
        means = {name: math.fsum(of) / len(of) if of else math.nan for name, of in values.items()}
        return Evaluation(metrics=means, images=self.images)


def merged(shares: Sequence[Measurements]) -> Measurements:
    """Those of all batches from those of some each, whoever measured which; images of the first share."""
    numbers: dict[str, list[float]] = {}
    of_objects: dict[str, dict[str, float]] = {}
    for share in shares:
        for name, values in share.numbers.items():
            numbers.setdefault(name, []).extend(values)
        for name, values_of in share.of_objects.items():
            of_objects[name] = values_of | of_objects.get(name, {})
    return Measurements(numbers=numbers, of_objects=of_objects, images=shares[0].images if shares else {})


@runtime_checkable
class Task(Protocol):
    """One thing to train."""

    @property
    def module(self) -> nn.Module:
        """Everything that has parameters to train; frozen parts may be inside or outside."""

    def loss(self, batch: Batch, generators: Sequence[torch.Generator]) -> Losses:
        """Loss of a batch. All randomness comes from the generators, one per sample (`step_generators.py`)."""

    def measure(self, batches: Iterable[Batch]) -> Measurements:
        """Numbers of every metric with the weights that the module holds now; no gradients.

        They depend on their own batch alone, randomness included (`batch_generator`), so ranks may share the batches.
        """
