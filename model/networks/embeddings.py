"""Embeddings of positions and of flow time (FORMATS 4.1)."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

__all__ = ["TimestepEmbedder", "sincos_position_embedding"]

_MAX_PERIOD = 10_000.0


def sincos_position_embedding(resolution: int, axes: int, channels: int) -> Float[Tensor, "token channel"]:
    """Absolute position embedding of a regular grid with `axes` axes, tokens in row-major order.

    Per axis channels // axes // 2 frequencies 1 / 10000^(i / count), sine then cosine of the integer index;
    axes one after the other; zeros at the end when channels do not divide (1024 on three axes: 4 zeros).
    """
    count = channels // axes // 2
    frequencies = _MAX_PERIOD ** (-torch.arange(count, dtype=torch.float32) / count)
    ticks = [torch.arange(resolution, dtype=torch.float32)] * axes
    index = torch.stack(torch.meshgrid(*ticks, indexing="ij"), dim=-1).reshape(-1, axes)
    angle = index[:, :, None] * frequencies
    embedding = torch.cat([angle.sin(), angle.cos()], dim=-1).flatten(1)
    return torch.nn.functional.pad(embedding, (0, channels - embedding.shape[1]))


class TimestepEmbedder(nn.Module):
    """256 sinusoids of 1000 t (cosine then sine), then Linear, SiLU, Linear."""

    frequency_channels = 256

    def __init__(self, channels: int) -> None:
        super().__init__()
        first = nn.Linear(self.frequency_channels, channels)
        self.mlp = nn.Sequential(first, nn.SiLU(), nn.Linear(channels, channels))

    def forward(self, t: Float[Tensor, " batch"]) -> Float[Tensor, "batch channel"]:
        """t in [0, 1], 1 is noise; the factor 1000 of TRELLIS is applied here and nowhere else."""
        half = self.frequency_channels // 2
        # Float32 whatever the autocast: bfloat16 cannot tell t = 0.500 from t = 0.501 times 1000.
        exponent = torch.arange(half, dtype=torch.float32, device=t.device) / half
        angle = 1000.0 * t.float()[:, None] * torch.exp(-math.log(_MAX_PERIOD) * exponent)
        sinusoids = torch.cat([angle.cos(), angle.sin()], dim=-1)
        return self.mlp(sinusoids.to(next(self.mlp.parameters()).dtype))
