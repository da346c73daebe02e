"""Images to an encoder's size, and its feature maps onto the common token grid, without shifting anything.

A cell of a feature map need not look at its even share of the image (WiLoR's patches start 2 px outside),
so every map says where its cells are centred, and tokens are read there.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from model.networks.patches import patchify

__all__ = ["CellCentres", "cells_per_token", "detailed_tokens", "resampled_tokens", "resized"]


@dataclass(frozen=True, kw_only=True)
class CellCentres:
    """Cell i of a square feature map is centred at first + spacing * i, in fractions of the image's side."""

    first: float
    spacing: float

    @staticmethod
    def aligned(count: int) -> "CellCentres":
        """`count` cells that share out the side evenly."""
        return CellCentres(first=0.5 / count, spacing=1.0 / count)


def resized(images: Float[Tensor, "view 3 from from"], size: int) -> Float[Tensor, "view 3 size size"]:
    """Bicubic and anti-aliased, corners on corners, kept in 0..1; the same tensor when nothing is to do."""
    if images.shape[-1] == size:
        return images
    # In float32: the anti-aliased kernel knows no bfloat16 on a CPU.
    scaled = functional.interpolate(images.float(), size=(size, size), mode="bicubic", antialias=True)
    return scaled.clamp(0, 1).to(images.dtype)


def resampled_tokens(
    features: Float[Tensor, "view channel cell cell"], centres: CellCentres, grid: int
) -> Float[Tensor, "view token channel"]:
    """A feature map read at the centres of a grid x grid token grid, row by row.

    Linear between cells; where tokens are wider than cells, the triangular mean over the token and its
    neighbours. Beyond the outermost cell centres, the outermost cells.
    """
    weights = _weights(centres, features.shape[-1], grid).to(features.device, features.dtype)
    rows = torch.einsum("gi,vcij->vcgj", weights, features)
    return torch.einsum("hj,vcgj->vghc", weights, rows).flatten(1, 2)


def cells_per_token(count: int, grid: int) -> int:
    """How many cells along an axis `detailed_tokens` keeps apart in a token: 2 where the map is that fine, else 1."""
    return 2 if count >= 2 * grid else 1


def detailed_tokens(
    features: Float[Tensor, "view channel cell cell"], grid: int
) -> Float[Tensor, "view token token_channel"]:
    """A map whose cells share out the side, on a grid x grid token grid, without blurring what is finer than it.

    A map at least twice as fine as the grid is read at 2 x 2 places in each token, side by side in its channels:
    outlines are finer than tokens.
    """
    count = features.shape[-1]
    apart = cells_per_token(count, grid)
    tokens = resampled_tokens(features, CellCentres.aligned(count), apart * grid)
    if apart == 1:
        return tokens
    return patchify(tokens.transpose(1, 2).unflatten(2, (apart * grid, apart * grid)), apart)


def _weights(centres: CellCentres, count: int, grid: int) -> Float[Tensor, "grid count"]:
    cells = centres.first + centres.spacing * torch.arange(count, dtype=torch.float64)
    tokens = ((torch.arange(grid, dtype=torch.float64) + 0.5) / grid).clamp(float(cells[0]), float(cells[-1]))
    reach = max(centres.spacing, 1.0 / grid)
    weights = (1 - (tokens[:, None] - cells).abs() / reach).clamp_min(0)
    return weights / weights.sum(1, keepdim=True)
