"""The paper's image encoder, DINOv2-L/14 with registers: patch tokens as TRELLIS conditions on them (FORMATS 4.5)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional
from transformers import Dinov2WithRegistersConfig, Dinov2WithRegistersModel

from model.encoders.token_grid import resized
from model.errors import ModelError
from shards.settings import Range

__all__ = ["DinoConfig", "DinoEncoder", "load_dino"]

_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet, sRGB
_PATCH = 14  # px; every published DINOv2
_SKIPPABLE = {"embeddings.mask_token"}  # for pre-training only
_ACTION = (
    "Download facebook/dinov2-with-registers-large (1.2 GB, Apache-2.0) with `hf download "
    "facebook/dinov2-with-registers-large --local-dir DIR` and give DIR, or choose the open EfficientNet encoder."
)


@dataclass(frozen=True, kw_only=True)
class DinoConfig:
    """`source`: folder written by `save_pretrained`, or hub id. `image_size`: pixels; the paper's is 518."""

    source: str | Path
    image_size: Annotated[int, Range(8, 8192)]
    local_files_only: bool
    """True: never ask the hub, take what is on the disk."""

    def __post_init__(self) -> None:
        if self.image_size < _PATCH or self.image_size % _PATCH:
            raise ModelError(
                "DINOv2 encoder",
                f"image_size is {self.image_size}",
                expected=f"a positive multiple of the patch size {_PATCH}",
                action="Take 518, the paper's size, for a grid of 37.",
            )

    @property
    def grid(self) -> int:
        return self.image_size // _PATCH


@dataclass(frozen=True, kw_only=True, eq=False)
class DinoEncoder:
    """Patch tokens before DINOv2's last norm; no CLS, no registers."""

    network: Dinov2WithRegistersModel
    config: DinoConfig
    normed: bool  # layer-normalised without parameters, as TRELLIS conditions on them

    @property
    def grid(self) -> int:
        return self.config.grid

    @property
    def channels(self) -> int:
        return self.network.config.hidden_size

    def to(self, device: torch.device | str, dtype: torch.dtype) -> "DinoEncoder":
        self.network.to(device, dtype)
        return self

    @torch.no_grad()
    def __call__(
        self, images: Float[Tensor, "batch view 3 size size"]
    ) -> Float[Tensor, "batch view token channel"]:
        pixels = resized(images.flatten(0, 1), self.config.image_size)
        mean, std = (torch.tensor(x).to(pixels).reshape(3, 1, 1) for x in (_MEAN, _STD))
        embedded = self.network.embeddings(((pixels - mean) / std).to(self.network.dtype))
        tokens = self.network.encoder(embedded).last_hidden_state
        patches = tokens[:, 1 + self.network.config.num_register_tokens :]
        if self.normed:
            patches = functional.layer_norm(patches, patches.shape[-1:])
        return patches.unflatten(0, images.shape[:2]).to(images.dtype)


def load_dino(config: DinoConfig) -> DinoEncoder:
    """DINOv2 from a folder or the hub, in float32 on the CPU.

    ModelError when there is nothing, when it is another network, or when weights are missing.
    """
    source = str(config.source)
    try:
        found = Dinov2WithRegistersConfig.get_config_dict(source, local_files_only=config.local_files_only)[0]
        _require_dino(source, found)
        loaded: Any = Dinov2WithRegistersModel.from_pretrained(
            source, local_files_only=config.local_files_only, output_loading_info=True, dtype=torch.float32
        )
    except ModelError:
        raise
    except (OSError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise _unusable(source, f"DINOv2 cannot be loaded ({reason})") from error
    network, report = loaded
    if missing := sorted(set(report["missing_keys"]) - _SKIPPABLE):
        raise _unusable(source, f"{len(missing)} weights are missing, first {missing[0]}")
    return DinoEncoder(network=network.eval().requires_grad_(False), config=config, normed=True)


def _require_dino(source: str, found: dict[str, Any]) -> None:
    if (kind := found.get("model_type")) != "dinov2_with_registers":
        raise _unusable(source, f"the network is {kind!r}")
    if (patch := found.get("patch_size", _PATCH)) != _PATCH:
        raise _unusable(source, f"its patches are {patch} px wide and not {_PATCH}")


def _unusable(source: str, problem: str) -> ModelError:
    expected = "a folder with config.json and model.safetensors of Dinov2WithRegistersModel, or its hub id"
    return ModelError(source, problem, expected=expected, action=_ACTION)
