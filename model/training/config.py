"""How a network is trained, whatever it is."""

import math
from dataclasses import dataclass
from typing import Annotated

from model.training.precision import Precision
from shards.settings import Range

__all__ = ["OptimizerConfig", "TrainerConfig"]


@dataclass(frozen=True, kw_only=True)
class OptimizerConfig:
    """Adam as in the paper (section 4.1: 5e-4)."""

    learning_rate: Annotated[float, Range(0, 1e3)]
    betas: Annotated[tuple[float, float], Range(0, 1)]
    weight_decay: Annotated[float, Range(0, 1e3)]
    warmup_steps: Annotated[int, Range(0, 1_000_000_000)]  # linear from 0
    # cosine to this share of the rate at the last step; 1: constant
    final_factor: Annotated[float, Range(0, 1)]
    clip_norm: Annotated[float, Range(1e-9, 1e9)]  # of the whole gradient

    def rate(self, step: int, steps: int) -> float:
        """Learning rate of step `step`, 0 .. steps - 1."""
        if step < self.warmup_steps:
            return self.learning_rate * (step + 1) / self.warmup_steps
        progress = (step - self.warmup_steps) / max(1, steps - self.warmup_steps)
        cosine = 0.5 * (1.0 + math.cos(math.pi * progress))
        return self.learning_rate * (self.final_factor + (1.0 - self.final_factor) * cosine)


@dataclass(frozen=True, kw_only=True)
class TrainerConfig:
    """Length, precision and bookkeeping of a run."""

    seed: Annotated[int, Range(0, 2**63 - 1)]
    steps: Annotated[int, Range(1, 1_000_000_000)]
    accumulate: Annotated[int, Range(1, 1_000_000_000)]  # batches per optimiser step
    precision: Precision
    ema_decay: Annotated[float, Range(0, 1)]
    checkpoint_every: Annotated[int, Range(1, 1_000_000_000)]
    keep_checkpoints: Annotated[int, Range(1, 1_000_000_000)]
    validate_every: Annotated[int, Range(1, 1_000_000_000)]
    log_every: Annotated[int, Range(1, 1_000_000_000)]

    def __post_init__(self) -> None:
        for name in (
            "steps",
            "accumulate",
            "checkpoint_every",
            "keep_checkpoints",
            "validate_every",
            "log_every",
        ):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: expected at least 1")
