"""sRGB and linear light (IEC 61966-2-1). Colours in shards are sRGB; glTF and light itself are linear."""

import numpy as np

from shards.array_types import Float

__all__ = ["linear_from_srgb", "srgb_from_linear"]


def linear_from_srgb(srgb: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """Linear light of sRGB values 0..1, in their dtype. Values above 1 (emission) follow the curve, below 0 it is 0."""
    srgb = np.maximum(srgb, 0.0)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """sRGB values 0..1 of linear light, in its dtype; values beyond 0..1 are clipped."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
