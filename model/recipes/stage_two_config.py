"""The configuration of a training of stage 2: structured-latent VAE, structured-latent flow."""

from dataclasses import dataclass

from model.data.config import DataConfig
from model.recipes.components.component import Component
from model.recipes.components.frozen_encoders import EncodersConfig
from model.recipes.components.recipe import ValidationConfig, require_held_out
from model.recipes.components.slat_flow_component import SlatFlowComponent, TrainedSlatFlow
from model.recipes.components.slat_vae_component import ImportedSlatVae, SlatVaeComponent, TrainedSlatVae
from model.structured_latent.mesh_evaluation import MeshEvaluationConfig
from model.structured_latent.object_features.surface_features import FEATURE_CHANNELS, SurfaceFeatures
from model.weights.published import PublishedNetwork
from model.weights.slat import slat_networks

__all__ = ["StageTwoTrainingConfig"]


@dataclass(frozen=True, kw_only=True)
class StageTwoTrainingConfig:
    """Everything that `forehoi train` needs for stage 2."""

    name: str
    data: DataConfig
    validation: ValidationConfig
    encoders: EncodersConfig
    meshes: MeshEvaluationConfig
    slat_vae: TrainedSlatVae | ImportedSlatVae
    slat_flow: TrainedSlatFlow

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

    @property
    def flow(self) -> SlatFlowComponent:
        """The component that the stage is for."""
        encoders, meshes, data = self.encoders, self.meshes, self.data
        vae = SlatVaeComponent(section=self.slat_vae, encoders=encoders, meshes=meshes, data=data)
        return SlatFlowComponent(section=self.slat_flow, encoders=encoders, vae=vae, meshes=meshes, data=data)

    def components(self) -> tuple[Component, ...]:
        """All that this configuration has, each after those that it stands on."""
        return (*self.flow.stands_on, self.flow)

    def published_networks(self) -> tuple[PublishedNetwork, ...]:
        """What of TRELLIS can be imported for it."""
        return slat_networks(self.slat_flow.network, self.slat_vae.network)
