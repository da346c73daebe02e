"""sRGB and linear light (IEC 61966-2-1). Colours of this project are sRGB; glTF wants COLOR_0 linear."""

import numpy as np
from jaxtyping import Float

__all__ = ["linear_from_srgb", "srgb_from_linear"]


def linear_from_srgb(srgb: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Linear light, 0..1, of sRGB values 0..1; values beyond are clipped."""
    clipped = np.clip(srgb, 0.0, 1.0)
    return np.where(clipped <= 0.04045, clipped / 12.92, ((clipped + 0.055) / 1.055) ** 2.4).astype(
        srgb.dtype
    )


def srgb_from_linear(linear: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """sRGB values, 0..1, of linear light 0..1; values beyond are clipped."""
    clipped = np.clip(linear, 0.0, 1.0)
    encoded = np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1.0 / 2.4) - 0.055)
    return encoded.astype(linear.dtype)
