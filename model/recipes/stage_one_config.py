"""The configuration of a training of stage 1: sparse-structure VAE, hand encoder, dual-branch flow."""

from dataclasses import dataclass

from model.data.config import DataConfig
from model.recipes.components.component import Component
from model.recipes.components.frozen_encoders import EncodersConfig, OwnHandEncoder
from model.recipes.components.hand_encoder_component import HandEncoderComponent, TrainedHandEncoder
from model.recipes.components.recipe import ValidationConfig, require_held_out
from model.recipes.components.stage_one_component import StageOneComponent, TrainedStageOne
from model.recipes.components.vae_component import ImportedVae, TrainedVae, VaeComponent
from model.weights.published import PublishedNetwork
from model.weights.trellis import stage_one_networks

__all__ = ["StageOneTrainingConfig"]


@dataclass(frozen=True, kw_only=True)
class StageOneTrainingConfig:
    """Everything that `forehoi train` needs for stage 1."""

    name: str
    data: DataConfig
    validation: ValidationConfig
    encoders: EncodersConfig
    vae: TrainedVae | ImportedVae
    hand_encoder: TrainedHandEncoder | None  # null: encoders.hand is not trained here
    stage_one: TrainedStageOne

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

    @property
    def flow(self) -> StageOneComponent:
        """The component that the stage is for."""
        section, data = self.hand_encoder, self.data
        return StageOneComponent(
            section=self.stage_one,
            encoders=self.encoders,
            vae=VaeComponent(section=self.vae, data=data),
            hand_encoder=None if section is None else HandEncoderComponent(section=section, data=data),
            data=data,
        )

    def components(self) -> tuple[Component, ...]:
        """All that this configuration has, each after those that it stands on."""
        return (*self.flow.stands_on, self.flow)

    def published_networks(self) -> tuple[PublishedNetwork, ...]:
        """What of TRELLIS can be imported for it."""
        return stage_one_networks(self.stage_one.network, self.vae.network)
