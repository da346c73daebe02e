"""The configuration of stage 2: every key checked, beside the one of stage 1."""

from dataclasses import dataclass
from pathlib import Path

from model.data.config import StreamConfig
from model.flow import LogitNormalTime, SamplerSettings, UniformTime
from model.networks.lora import LoraSettings
from model.recipes.config import (
    EncodersConfig,
    Recipe,
    TrainingConfig,
    ValidationConfig,
    parse_yaml,
    read_settings,
    require_adapter,
    require_condition,
    require_held_out,
)
from model.structured_latent.flow import SlatFlowConfig
from model.structured_latent.mesh_evaluation import MeshEvaluationConfig
from model.structured_latent.object_features.surface_features import FEATURE_CHANNELS, SurfaceFeatures
from model.structured_latent.object_features.view_features import ViewFeaturesConfig
from model.structured_latent.vae.latent import SlatVaeConfig
from model.structured_latent.vae.surface_loss import SurfaceLossConfig
from shards.settings import Origins, settings_from_dict

__all__ = [
    "ImportedSlatVae",
    "SlatFlowPart",
    "SlatTrainingConfig",
    "SlatVaePart",
    "load_any_config",
    "parse_any_config",
]


@dataclass(frozen=True, kw_only=True)
class SlatVaePart:
    """The structured-latent VAE, trained here, and what its encoder reads of an object."""

    network: SlatVaeConfig
    features: SurfaceFeatures | ViewFeaturesConfig
    loss: SurfaceLossConfig
    recipe: Recipe


@dataclass(frozen=True, kw_only=True)
class ImportedSlatVae:
    """The structured-latent VAE with weights that are there already; not trained."""

    network: SlatVaeConfig
    features: SurfaceFeatures | ViewFeaturesConfig
    weights: Path  # made by `forehoi weights import`


@dataclass(frozen=True, kw_only=True)
class SlatFlowPart:
    """The structured-latent flow and what conditions it.

    `start`: a weight file to start from, null for random ones. `lora`: adapt the attention projections of the flow and
    freeze the rest of it, null to train it whole; what is new in stage 2 always trains whole.
    """

    network: SlatFlowConfig
    start: Path | None
    lora: LoraSettings | None
    hand_width: int  # of the aggregator (section 3.1)
    hidden: int
    drop_condition: float
    time: UniformTime | LogitNormalTime
    sampler: SamplerSettings
    guidance_strength: float
    guidance_interval: tuple[float, float]
    recipe: Recipe

    def __post_init__(self) -> None:
        require_condition(self.drop_condition, self.guidance_strength)
        require_adapter(self.lora, starts=self.start is not None)


@dataclass(frozen=True, kw_only=True)
class SlatTrainingConfig:
    """Everything that `forehoi train` needs for stage 2. Recipes replace the sizes in `data`."""

    name: str
    data: StreamConfig
    validation: ValidationConfig
    encoders: EncodersConfig
    meshes: MeshEvaluationConfig
    slat_vae: SlatVaePart | ImportedSlatVae
    slat_flow: SlatFlowPart

    def __post_init__(self) -> None:
        require_held_out(self.data, self.validation)
        vae, flow = self.slat_vae.network, self.slat_flow.network
        own_surface = isinstance(self.slat_vae.features, SurfaceFeatures)
        if own_surface and vae.feature_channels != FEATURE_CHANNELS:
            raise ValueError(
                f"slat_vae.network.feature_channels is {vae.feature_channels}: expected {FEATURE_CHANNELS}, the "
                "features of an object's own surface (slat_vae.features: {}); those of views, "
                "{views: 150, image_size: 518, ...}, have the channels of encoders.image"
            )
        if (vae.latent_channels, vae.resolution) != (flow.latent_channels, flow.resolution):
            raise ValueError(
                f"slat_flow.network takes {flow.latent_channels} channels at {flow.resolution}^3, the VAE makes "
                f"{vae.latent_channels} at {vae.resolution}^3: expected the same"
            )


def parse_any_config(text: str, *, where: str) -> TrainingConfig | SlatTrainingConfig:
    """A configuration of stage 1 or of stage 2 from YAML text: of stage 2 when it has its parts."""
    return _of_its_stage(parse_yaml(text, where=where), where)


def load_any_config(name: str | Path) -> TrainingConfig | SlatTrainingConfig:
    """The configuration of either stage in a preset or a file; SettingsError names file, key, expected and found."""
    merged = read_settings(name)
    return _of_its_stage(merged.data, merged.origins)


def _of_its_stage(data: object, where: str | Origins) -> TrainingConfig | SlatTrainingConfig:
    if isinstance(data, dict) and data.keys() & {"slat_vae", "slat_flow"}:
        return settings_from_dict(SlatTrainingConfig, data, where=where)
    return settings_from_dict(TrainingConfig, data, where=where)
