"""How a network is trained, whatever it is."""

import math
from dataclasses import dataclass

from model.training.precision import Precision

__all__ = ["OptimizerConfig", "TrainerConfig"]


@dataclass(frozen=True, kw_only=True)
class OptimizerConfig:
    """Adam as in the paper (section 4.1: 5e-4)."""

    learning_rate: float
    betas: tuple[float, float]
    weight_decay: float
    warmup_steps: int  # linear from 0
    final_factor: float  # cosine to this share of the rate at the last step; 1: constant
    clip_norm: float  # of the whole gradient

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

    seed: int
    steps: int
    accumulate: int  # batches per optimiser step
    precision: Precision
    ema_decay: float
    checkpoint_every: int
    keep_checkpoints: int
    validate_every: int
    log_every: int

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
