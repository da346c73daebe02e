"""The open hand encoder: a small decoder on the frozen ImageNet pyramid, trained on our own shards to find the hand,
its 21 joints and what it holds. On few images this beats a network trained from scratch by far (DECISIONS D39).

`forehoi train hand_encoder` makes its weights (`hand_training.py`); `packaged_hand_net` gives those that ship with
the package (model/encoders/data). It sees the same crop as the image encoder.
"""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

from model.encoders.efficientnet import PYRAMID_CHANNELS, ImageNetPyramid
from model.encoders.token_grid import cells_per_token, detailed_tokens, resized
from model.errors import ModelError
from model.tensor_files.safetensors_file import write_tensors
from shards.settings import Range
from shards.storage.whole_file import write_whole

__all__ = [
    "N_JOINTS",
    "HandEncoder",
    "HandNet",
    "HandNetConfig",
    "HandOutput",
    "load_hand_net",
    "packaged_hand_net",
    "packaged_hand_sha256",
    "save_hand_net",
]

N_JOINTS = 21
_COARSEST = max(PYRAMID_CHANNELS)
_BACKBONE = "backbone."  # frozen, from its own package: not in our file
_WEIGHTS, _CONFIG = "hand_encoder.safetensors", "hand_encoder.json"
_PACKAGED = Path(__file__).parent / "data"
_ACTION = "Make it with `forehoi train hand_encoder --config hands`, or give the folder of a made one."


@dataclass(frozen=True, kw_only=True)
class HandNetConfig:
    """`image_size`: pixels at which it runs, a multiple of 32. `stem`: channels at strides 2 and 4 of what it sees by
    itself, fine outlines; `decoder`: channels of its maps. All channels are multiples of 8."""

    image_size: Annotated[int, Range(8, 8192)]
    stem: Annotated[tuple[int, int], Range(1, 65_536)]
    decoder: Annotated[int, Range(1, 65_536)]

    def __post_init__(self) -> None:
        if self.image_size < _COARSEST or self.image_size % _COARSEST:
            raise self._error(f"image_size is {self.image_size}", f"a positive multiple of {_COARSEST}")
        if len(self.stem) != 2 or any(width < 8 or width % 8 for width in (*self.stem, self.decoder)):
            problem = f"stem is {self.stem}, decoder is {self.decoder}"
            raise self._error(problem, "two widths and a decoder, positive multiples of 8")

    @staticmethod
    def _error(problem: str, expected: str) -> ModelError:
        return ModelError("hand encoder", problem, expected=expected, action="Correct the configuration.")


@dataclass(frozen=True, kw_only=True)
class HandOutput:
    """What is predicted, at stride 4; cell [r, c] is centred at ((c + 0.5), (r + 0.5)) cells."""

    mask_logits: Float[Tensor, "view cell cell"]
    """Hand and arm, as far as visible."""
    object_logits: Float[Tensor, "view cell cell"]
    """The held object, as far as visible: told from other things by the hand on it."""
    joint_logits: Float[Tensor, "view 21 cell cell"]
    """Where each joint is, hidden or not; a softmax over the cells makes a distribution of it."""
    right_logit: Float[Tensor, " view"]


class _Residual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.body = nn.Sequential(_convolution(width, width, 3), _convolution(width, width, 3))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.body(x)


def _convolution(channels: int, width: int, kernel: int, *, stride: int = 1) -> nn.Sequential:
    # Group norm: a step must not depend on how a batch is spread over processes.
    conv = nn.Conv2d(channels, width, kernel, stride=stride, padding=(kernel - 1) // 2, bias=False)
    return nn.Sequential(conv, nn.GroupNorm(8, width), nn.SiLU())


class HandNet(nn.Module):
    """From the pyramid's coarsest maps to stride 4, taking in each finer one; at stride 4 also its own stem's."""

    def __init__(self, config: HandNetConfig) -> None:
        super().__init__()
        self.config = config
        decoder, (w2, w4) = config.decoder, config.stem
        self.backbone = ImageNetPyramid()
        # Kernels of 4 at stride 2 look exactly at their cells; those of 3 would look half a pixel aside.
        self.stem = nn.Sequential(
            _convolution(3, w2, 4, stride=2),
            _convolution(w2, w4, 4, stride=2),
            _Residual(w4),
            nn.Conv2d(w4, decoder, 1),
        )
        self.lateral_4, self.lateral_8, self.lateral_16, self.lateral_32 = (
            nn.Conv2d(channels, decoder, 1) for channels in PYRAMID_CHANNELS.values()
        )
        self.at_16 = nn.Sequential(_convolution(decoder, decoder, 3), _Residual(decoder))
        self.at_8, self.at_4 = (_convolution(decoder, decoder, 3) for _ in range(2))
        self.maps = nn.Conv2d(decoder, 2 + N_JOINTS, 1)
        self.side = nn.Linear(decoder, 1)

    def channels(self, grid: int) -> int:
        """Width of a token of `features`."""
        counts = (self.config.image_size // 4, self.config.image_size // 16)
        return sum(cells_per_token(count, grid) ** 2 for count in counts) * self.config.decoder

    def forward(self, images: Float[Tensor, "view 3 size size"]) -> HandOutput:
        """Predictions for sRGB images in 0..1 of any size."""
        fine, coarse = self._decoded(images)
        maps = self.maps(fine)
        return HandOutput(
            mask_logits=maps[:, 0],
            object_logits=maps[:, 1],
            joint_logits=maps[:, 2:],
            right_logit=self.side(coarse.mean((2, 3)))[:, 0],
        )

    @torch.no_grad()
    def visible_object(self, images: Float[Tensor, "view 3 size size"]) -> Bool[Tensor, "view size size"]:
        """Mask of the held object as far as it is seen, at the images' size."""
        logits = self(images).object_logits[:, None].float()
        return functional.interpolate(logits, size=images.shape[-2:], mode="bilinear")[:, 0] > 0

    def features(
        self, images: Float[Tensor, "view 3 size size"], grid: int
    ) -> Float[Tensor, "view token channel"]:
        """What the predictions are read from, as tokens: the stride-4 map (masks, joints) and the stride-16
        map (side, context), each layer-normalised without parameters."""
        levels = [detailed_tokens(level, grid) for level in self._decoded(images)]
        return torch.cat([functional.layer_norm(level, level.shape[-1:]) for level in levels], dim=-1)

    def _decoded(self, images: Tensor) -> tuple[Tensor, Tensor]:
        pixels = resized(images, self.config.image_size)
        on_4, on_8, on_16, on_32 = (_normalised(level) for level in self.backbone(pixels).values())
        coarse = self.at_16(self.lateral_16(on_16) + _doubled(self.lateral_32(on_32)))
        middle = self.at_8(self.lateral_8(on_8) + _doubled(coarse))
        own = self.stem((4 * pixels - 2).to(self.side.weight.dtype))
        return self.at_4(self.lateral_4(on_4) + own + _doubled(middle)), coarse


def _normalised(features: Float[Tensor, "view channel i j"]) -> Float[Tensor, "view channel i j"]:
    """Each cell layer-normalised, so that every stride has the same weight."""
    return functional.layer_norm(features.movedim(1, -1), features.shape[1:2]).movedim(-1, 1)


def _doubled(features: Tensor) -> Tensor:
    return functional.interpolate(features, scale_factor=2, mode="nearest")


@dataclass(frozen=True, kw_only=True, eq=False)
class HandEncoder:
    """A trained HandNet as frozen encoder."""

    network: HandNet
    grid: int

    @property
    def channels(self) -> int:
        return self.network.channels(self.grid)

    def to(self, device: torch.device | str, dtype: torch.dtype) -> "HandEncoder":
        self.network.to(device, dtype)
        return self

    @torch.no_grad()
    def __call__(
        self, images: Float[Tensor, "batch view 3 size size"]
    ) -> Float[Tensor, "batch view token channel"]:
        tokens = self.network.features(images.flatten(0, 1), self.grid)
        return tokens.unflatten(0, images.shape[:2]).to(images.dtype)


def save_hand_net(network: HandNet, folder: Path, *, dtype: torch.dtype) -> None:
    """Weights (as `dtype`) and configuration into `folder`; each file appears whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    own = {name: value for name, value in network.state_dict().items() if not name.startswith(_BACKBONE)}
    write_tensors(folder / _WEIGHTS, {name: value.to(dtype) for name, value in own.items()})
    with write_whole(folder / _CONFIG) as partial:
        partial.write_text(json.dumps(asdict(network.config), indent=1) + "\n", encoding="utf-8")


def load_hand_net(folder: Path) -> HandNet:
    """A frozen HandNet in float32 on the CPU. ModelError when it is missing, broken or of another layout."""
    try:
        stored = json.loads((folder / _CONFIG).read_text(encoding="utf-8"))
        config = HandNetConfig(**{**stored, "stem": tuple(stored["stem"])})
        tensors = load_file(folder / _WEIGHTS)
    except FileNotFoundError as error:
        missing = Path(error.filename or _WEIGHTS).name
        raise _unusable(folder, f"there is no {missing}") from error
    except ModelError:
        raise
    except (OSError, SafetensorError, ValueError, TypeError, KeyError) as error:
        raise _unusable(
            folder, f"the hand encoder cannot be read ({' '.join(str(error).split())[:160]})"
        ) from error
    network = HandNet(config)
    backbone = {name: value for name, value in network.state_dict().items() if name.startswith(_BACKBONE)}
    try:
        network.load_state_dict({name: value.float() for name, value in tensors.items()} | backbone)
    except RuntimeError as error:
        raise _unusable(folder, f"the weights are of another layout than {_CONFIG} says") from error
    return network.eval().requires_grad_(False)


def packaged_hand_net() -> HandNet:
    """The hand encoder that ships with the package; how it was made: model/encoders/data/README.md."""
    return load_hand_net(_PACKAGED)


def packaged_hand_sha256() -> str:
    """Digest of its weights: another version of the package may bring others."""
    return hashlib.sha256((_PACKAGED / _WEIGHTS).read_bytes()).hexdigest()


def _unusable(folder: Path, problem: str) -> ModelError:
    return ModelError(folder, problem, expected=f"a folder with {_WEIGHTS} and {_CONFIG}", action=_ACTION)
