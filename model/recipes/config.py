"""The whole configuration of a training: YAML that is complete once merged, every key checked.

Each section is a dataclass beside the code it configures; this file assembles them and reads the
YAML strictly.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import yaml

from model.data.config import StreamConfig
from model.encoders.dino import DinoConfig
from model.encoders.efficientnet import EfficientNetConfig
from model.encoders.hand import HandNetConfig
from model.encoders.hand_training import HandLossConfig
from model.encoders.wilor import WilorConfig
from model.flow import LogitNormalTime, SamplerSettings, UniformTime
from model.networks.lora import LoraSettings
from model.sparse_structure.dual_branch import DualBranchConfig
from model.sparse_structure.vae import VaeConfig
from model.training.config import OptimizerConfig, TrainerConfig
from model.weights.weight_file import StartConfig
from shards.configuration.layers import MergedSettings, Replacement, read_layers
from shards.settings import SettingsError, settings_from_dict
from shards.splits import Split

__all__ = [
    "PRESETS",
    "EncodersConfig",
    "HandPart",
    "ImportedVae",
    "OwnHandEncoder",
    "PackagedHandEncoder",
    "Recipe",
    "StageOnePart",
    "TrainingConfig",
    "VaePart",
    "ValidationConfig",
    "as_yaml",
    "load_config",
    "parse_config",
    "parse_yaml",
    "read_settings",
    "require_adapter",
    "require_condition",
    "require_held_out",
]

PRESETS = (Path(__file__).parents[1] / "presets").resolve()


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
    """The sparse-structure VAE, trained here; `turn`: on shapes in all 48 orientations of the cube."""

    network: VaeConfig
    turn: bool
    recipe: Recipe


@dataclass(frozen=True, kw_only=True)
class ImportedVae:
    """The sparse-structure VAE with weights that are there already."""

    network: VaeConfig
    weights: Path  # made by `forehoi weights import`


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
class PackagedHandEncoder:
    """The hand encoder that ships with the package, on a token grid of its own."""

    packaged_grid: int


@dataclass(frozen=True, kw_only=True)
class EncodersConfig:
    """Frozen encoders of the images."""

    image: EfficientNetConfig | DinoConfig
    hand: OwnHandEncoder | PackagedHandEncoder | WilorConfig
    cached_views: int  # images whose features are kept; of use where crops repeat, 0: none


@dataclass(frozen=True, kw_only=True)
class StageOnePart:
    """The dual-branch flow and its feature aggregator.

    `start`: weights to start from, null for random ones. `lora`: adapt the attention projections of the geometry
    branch and freeze the rest of it, null to train it whole; everything else always trains whole.
    """

    network: DualBranchConfig
    start: StartConfig | None
    lora: LoraSettings | None
    hand_width: int  # of the aggregator (section 3.1)
    hidden: int
    beta: float
    drop_condition: float
    time: UniformTime | LogitNormalTime
    sampler: SamplerSettings
    guidance_strength: float  # of the shape; masks go unguided
    guidance_interval: tuple[float, float]
    recipe: Recipe

    def __post_init__(self) -> None:
        if self.beta < 0:
            raise ValueError(f"beta is {self.beta}: expected beta >= 0")
        require_condition(self.drop_condition, self.guidance_strength)
        require_adapter(self.lora, starts=self.start is not None)


@dataclass(frozen=True, kw_only=True)
class ValidationConfig:
    """What the metrics while training are measured on.

    `split`: that of the training for held-out cameras of its motions, another one for all cameras of objects
    that were never trained on.
    """

    split: Split
    views: int
    batch_size: int
    samples_per_motion: int  # each with its own views
    batches: int  # at most

    def __post_init__(self) -> None:
        if min(self.views, self.batch_size, self.samples_per_motion, self.batches) < 1:
            raise ValueError(f"a number in {self} is below 1: expected at least one of each")


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """Everything that `forehoi train` needs. `data` is what all parts share; recipes replace its sizes."""

    name: str
    data: StreamConfig
    validation: ValidationConfig
    encoders: EncodersConfig
    vae: VaePart | ImportedVae
    hand_encoder: HandPart | None  # null: encoders.hand is not trained here
    stage_one: StageOnePart

    def __post_init__(self) -> None:
        require_held_out(self.data, self.validation)
        network, grid = self.stage_one.network, self.encoders.image.grid
        if network.masks.grid != grid:
            raise ValueError(
                f"stage_one.network.masks.grid is {network.masks.grid} and the grid of encoders.image {grid}: "
                "mask tokens lie on the image tokens; expected the same number"
            )
        latent = self.vae.network.latent_shape(64)
        if network.geometry.latent_shape != latent:
            raise ValueError(
                f"stage_one.network.geometry takes latents {network.geometry.latent_shape}, the VAE makes {latent}: "
                "expected the same shape; correct latent_resolution and latent_channels, or vae.network.channels"
            )
        own = isinstance(self.encoders.hand, OwnHandEncoder)
        if own != (self.hand_encoder is not None):
            raise ValueError(
                "encoders.hand is the own hand encoder and hand_encoder is null: expected how to train it"
                if own
                else "hand_encoder is trained and encoders.hand uses another: expected hand_encoder to be null"
            )


def require_held_out(data: StreamConfig, validation: ValidationConfig) -> None:
    """ValueError: data that end, or metrics on what is trained on."""
    if not data.endless:
        raise ValueError(
            "data.endless is false: training draws batches for as many steps as it takes; expected true"
        )
    if validation.split == data.split and data.cameras != "train":
        raise ValueError(
            f"validation.split is that of the training and data.cameras is {data.cameras}: expected cameras: train, "
            "so that metrics are of cameras that were not trained on, or another split"
        )


def require_adapter(lora: LoraSettings | None, *, starts: bool) -> None:
    """ValueError: adapters on nothing, or with dropout.

    All randomness of a step is drawn from its own generators, or no resume would be exact.
    """
    if lora is None:
        return
    if lora.dropout > 0:
        raise ValueError(
            f"lora.dropout is {lora.dropout}: expected 0, as in the paper; a resume would not be exact"
        )
    if not starts:
        raise ValueError(
            "lora adapts weights that are there, and start is null: expected a file to start from; "
            "name one (`forehoi weights import`), or set lora to null"
        )


def require_condition(drop_condition: float, guidance_strength: float) -> None:
    """ValueError: no share, or guidance by a velocity that is never trained."""
    if not 0 <= drop_condition < 1:
        raise ValueError(f"drop_condition is {drop_condition}: expected a share below 1")
    if guidance_strength != 0 and drop_condition == 0:
        raise ValueError(
            f"guidance_strength is {guidance_strength} and drop_condition 0: guidance needs the velocity without a "
            "condition; expected drop_condition > 0, or guidance_strength 0"
        )


def read_settings(name: str | Path) -> MergedSettings:
    """Content of a preset, `tiny`, or a file, `path/to/own.yaml`, merged with what it extends. SettingsError."""
    return read_layers(name, PRESETS, parse_yaml)


class _Loader(yaml.SafeLoader):
    """Plain content and `!replace`."""

    def replacement(self, node: yaml.Node) -> Replacement:
        return Replacement(self.construct_mapping(node, deep=True))  # type: ignore[arg-type]  # refuses others itself


_Loader.add_constructor("!replace", _Loader.replacement)


def parse_yaml(text: str, where: str) -> object:
    """Content of YAML text; `where` names it in errors. SettingsError."""
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        raise SettingsError(f"{where}: not valid YAML: {' '.join(str(error).split())}") from error


def load_config(name: str | Path) -> TrainingConfig:
    """The configuration of stage 1 in a preset or a file; SettingsError names file, key, expected and found."""
    merged = read_settings(name)
    return settings_from_dict(TrainingConfig, merged.data, where=merged.origins)


def parse_config(text: str, *, where: str) -> TrainingConfig:
    """A complete configuration of stage 1 from YAML text, e.g. of a checkpoint."""
    return settings_from_dict(TrainingConfig, parse_yaml(text, where=where), where=where)


def as_yaml(config: object) -> str:
    """A configuration, or a part of one, as text that `load_config` reads back."""
    return yaml.safe_dump(json.loads(json.dumps(asdict(config), default=str)), sort_keys=False)  # type: ignore[call-overload]
