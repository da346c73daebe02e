"""The whole configuration of a training: one complete YAML file, every key checked.

Each section is a dataclass beside the code it configures; this file assembles them and reads the
YAML strictly.
"""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import yaml

from model.encoders.dino import DinoConfig
from model.encoders.efficientnet import EfficientNetConfig
from model.encoders.hand import HandNetConfig
from model.encoders.hand_training import HandLossConfig
from model.encoders.wilor import WilorConfig
from model.errors import ModelError
from model.flow import LogitNormalTime, SamplerSettings, UniformTime
from model.sparse_structure.dual_branch import DualBranchConfig
from model.sparse_structure.vae import VaeConfig
from model.stream_config import StreamConfig
from model.training.config import OptimizerConfig, TrainerConfig
from shards.settings import SettingsError, settings_from_dict

__all__ = [
    "EncodersConfig",
    "HandPart",
    "OwnHandEncoder",
    "Recipe",
    "StageOnePart",
    "TrainingConfig",
    "VaePart",
    "ValidationConfig",
    "load_config",
    "part_sha256",
]


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How one part is trained on the shared data."""

    trainer: TrainerConfig
    optimizer: OptimizerConfig
    batch_size: int
    views: tuple[int, int]
    image_size: int  # px


@dataclass(frozen=True, kw_only=True)
class VaePart:
    """The sparse-structure VAE."""

    network: VaeConfig
    recipe: Recipe


@dataclass(frozen=True, kw_only=True)
class HandPart:
    """The open hand encoder."""

    network: HandNetConfig
    loss: HandLossConfig
    recipe: Recipe


@dataclass(frozen=True, kw_only=True)
class OwnHandEncoder:
    """The hand encoder that this configuration trains, on a token grid of its own."""

    own_grid: int


@dataclass(frozen=True, kw_only=True)
class EncodersConfig:
    """Frozen encoders of the pictures."""

    image: EfficientNetConfig | DinoConfig
    hand: OwnHandEncoder | WilorConfig
    cached_views: int  # pictures whose features are kept; of use where crops repeat, 0: none


@dataclass(frozen=True, kw_only=True)
class StageOnePart:
    """The dual-branch flow and its feature aggregator."""

    network: DualBranchConfig
    hand_width: int  # of the aggregator (section 3.1)
    hidden: int
    beta: float
    drop_condition: float
    time: UniformTime | LogitNormalTime
    sampler: SamplerSettings
    guidance_strength: float  # of the shape; masks go unguided
    guidance_interval: tuple[float, float]
    recipe: Recipe


@dataclass(frozen=True, kw_only=True)
class ValidationConfig:
    """What the figures while training are measured on: held-out cameras of training motions."""

    views: int
    batch_size: int
    batches: int  # at most


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """Everything that `forehoi train` needs. `data` is what all parts share; recipes replace its sizes."""

    name: str
    data: StreamConfig
    validation: ValidationConfig
    encoders: EncodersConfig
    vae: VaePart
    hand_encoder: HandPart
    stage_one: StageOnePart

    def __post_init__(self) -> None:
        network, image = self.stage_one.network, self.encoders.image
        grid = getattr(image, "grid", None)
        if grid is not None and network.masks.grid != grid:
            raise ValueError(
                f"stage_one.network.masks.grid is {network.masks.grid} and encoders.image.grid {grid}: "
                "mask tokens lie on the image tokens; expected the same number"
            )
        latent = self.vae.network.latent_shape(64)
        if network.geometry.latent_shape != latent:
            raise ValueError(
                f"stage_one.network.geometry takes latents {network.geometry.latent_shape}, the VAE makes {latent}: "
                "expected the same shape; correct latent_resolution and latent_channels, or vae.network.channels"
            )


def load_config(path: Path) -> TrainingConfig:
    """Read a complete YAML file; SettingsError names file, key, expected and found."""
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ModelError(
            path, "does not exist", expected="a training configuration", action="See configs/model."
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from error
    return settings_from_dict(TrainingConfig, data, where=str(path))


def as_yaml(config: object) -> str:
    """A configuration, or a part of one, as text that `load_config` reads back."""
    return yaml.safe_dump(json.loads(json.dumps(asdict(config), default=str)), sort_keys=False)  # type: ignore[call-overload]


def part_sha256(*parts: object) -> str:
    """Changes when anything that decides the trained weights of a part changes."""
    return hashlib.sha256("\n".join(as_yaml(part) for part in parts).encode()).hexdigest()
