"""The feature aggregator of the paper (section 3.1): hand features join the image features patch by patch."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

__all__ = ["AggregatorConfig", "FeatureAggregator"]


@dataclass(frozen=True, kw_only=True)
class AggregatorConfig:
    """Paper: image 1024 on a 37 grid, hand 1280 on a 14 grid -> hand_width 1024, concatenated 2048 -> 1024.

    The paper gives the concatenated width and the output; `hidden`, the inner width of the MLP, is ours
    (2048 in the paper configuration).
    """

    image_channels: int
    image_grid: int
    hand_channels: int
    hand_grid: int
    hand_width: int
    hidden: int
    channels: int


class FeatureAggregator(nn.Module):
    """F_input = [F_image, CNN(F_hand)], then a two-layer MLP; tokens on the image grid.

    The CNN mixes neighbours on the hand grid, resamples, and smooths on the image grid.
    """

    def __init__(self, config: AggregatorConfig) -> None:
        super().__init__()
        self.config = config
        width = config.hand_width
        self.hand_mix = nn.Conv2d(config.hand_channels, width, 3, padding=1, padding_mode="replicate")
        self.hand_smooth = nn.Conv2d(width, width, 3, padding=1, padding_mode="replicate", groups=width)
        self.mlp = nn.Sequential(
            nn.Linear(config.image_channels + width, config.hidden),
            nn.GELU(approximate="tanh"),
            nn.Linear(config.hidden, config.channels),
        )

    @property
    def grid(self) -> int:
        """Tokens along one side."""
        return self.config.image_grid

    def forward(
        self,
        image_tokens: Float[Tensor, "batch view token image_channel"],
        hand_tokens: Float[Tensor, "batch view hand_token hand_channel"],
    ) -> Float[Tensor, "batch view token channel"]:
        """Fused features, one token per image token, row-major from the top left."""
        batch_view = image_tokens.shape[:2]
        map_ = (
            hand_tokens.flatten(0, 1)
            .transpose(1, 2)
            .unflatten(2, (self.config.hand_grid, self.config.hand_grid))
        )
        map_ = functional.gelu(self.hand_mix(map_), approximate="tanh")
        # Both grids cover the same image, corners on corners.
        size = (self.config.image_grid, self.config.image_grid)
        shrinks = self.config.image_grid < self.config.hand_grid
        if self.config.image_grid != self.config.hand_grid:
            # In float32: the anti-aliased kernel knows no bfloat16 on a CPU.
            resampled = functional.interpolate(
                map_.float(), size=size, mode="bilinear", align_corners=False, antialias=shrinks
            )
            map_ = resampled.to(map_.dtype)
        hand = self.hand_smooth(map_).flatten(2).transpose(1, 2).unflatten(0, batch_view)
        return self.mlp(torch.cat([image_tokens, hand], dim=-1))
