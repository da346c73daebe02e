"""Exponential moving average of trainable parameters."""

import torch
from torch import nn

__all__ = ["MovingAverage"]


class MovingAverage:
    """Averages of the trainable parameters, in float32 on their own device.

    The first steps count more: the decay is at most (1 + step) / (10 + step), so a short run is
    not dominated by its initial weights.
    """

    def __init__(self, module: nn.Module, decay: float) -> None:
        if not 0.0 <= decay < 1.0:
            raise ValueError(f"EMA decay is {decay}: expected 0 <= decay < 1")
        self.decay = decay
        self.averages = {
            name: parameter.detach().to(torch.float32, copy=True)
            for name, parameter in module.named_parameters()
            if parameter.requires_grad
        }

    @torch.no_grad()
    def update(self, module: nn.Module, step: int) -> None:
        """Blend in the parameters after optimiser step `step` (from 1)."""
        decay = min(self.decay, (1.0 + step) / (10.0 + step))
        for name, parameter in module.named_parameters():
            if name in self.averages:
                self.averages[name].lerp_(parameter.detach().float(), 1.0 - decay)

    @torch.no_grad()
    def swap(self, module: nn.Module) -> None:
        """Exchange averages and parameters; a second call takes it back, bit-exactly."""
        for name, parameter in module.named_parameters():
            if name in self.averages:
                current = parameter.detach().to(torch.float32, copy=True)
                parameter.copy_(self.averages[name])
                self.averages[name] = current
