"""The structured-latent VAE of stage 2: trained here, or imported; and what its encoder reads of an object."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import torch

from model.data.config import DataConfig
from model.encoders.protocol import FeatureEncoder
from model.errors import ModelError
from model.recipes.components.component import Component
from model.recipes.components.component_data import ComponentData
from model.recipes.components.component_identity import as_yaml, deciding_data, deciding_recipe, sha256_of
from model.recipes.components.frozen_encoders import EncodersConfig, image_encoder
from model.recipes.components.recipe import Recipe
from model.structured_latent.mesh_evaluation import MeshEvaluationConfig
from model.structured_latent.object_features.object_input import ObjectInputs
from model.structured_latent.object_features.object_mesh import ObjectMeshes
from model.structured_latent.object_features.surface_features import SurfaceFeatures
from model.structured_latent.object_features.view_encoder import view_encoder
from model.structured_latent.object_features.view_features import ViewFeatures, ViewFeaturesConfig
from model.structured_latent.vae.latent import SlatVaeConfig
from model.structured_latent.vae.surface_loss import SurfaceLossConfig
from model.structured_latent.vae_training import SlatVae, SlatVaeTask
from model.weights.slat import load_slat_vae
from model.weights.weight_file import weights_sha256

__all__ = ["ImportedSlatVae", "SlatVaeComponent", "TrainedSlatVae"]


@dataclass(frozen=True, kw_only=True)
class TrainedSlatVae:
    """The VAE, trained here, and what its encoder reads of an object."""

    network: SlatVaeConfig
    features: SurfaceFeatures | ViewFeaturesConfig
    loss: SurfaceLossConfig
    recipe: Recipe


@dataclass(frozen=True, kw_only=True)
class ImportedSlatVae:
    """The VAE with weights that are there already."""

    network: SlatVaeConfig
    features: SurfaceFeatures | ViewFeaturesConfig
    weights: Path  # made by `forehoi weights import`


@dataclass(frozen=True, kw_only=True)
class SlatVaeComponent(Component):
    """The VAE of a configuration."""

    name: ClassVar[str] = "slat_vae"
    reads_surfaces: ClassVar[bool] = True
    section: TrainedSlatVae | ImportedSlatVae
    encoders: EncodersConfig  # `image` also makes features of views
    meshes: MeshEvaluationConfig
    data: DataConfig

    @property
    def recipe(self) -> Recipe | None:
        return self.section.recipe if isinstance(self.section, TrainedSlatVae) else None

    def sha256(self) -> str:
        section, texts = self.section, list[str]()
        if not isinstance(section.features, SurfaceFeatures):
            section = replace(section, features=replace(section.features, cache=None))
            texts.append(as_yaml(self.encoders.image))
        if isinstance(section, ImportedSlatVae):
            return sha256_of(as_yaml(section), weights_sha256(section.weights), *texts)
        section = replace(section, recipe=deciding_recipe(section.recipe))
        return sha256_of(as_yaml(section), as_yaml(deciding_data(self.data)), *texts)

    def task(self, run: Path, data: ComponentData, device: torch.device) -> SlatVaeTask:  # noqa: ARG002
        assert isinstance(self.section, TrainedSlatVae)  # else it has no recipe
        return SlatVaeTask(
            network=SlatVae(self.section.network),
            loss_config=self.section.loss,
            evaluation=self.meshes,
            inputs=self.inputs(data, None, device),
        )

    def load(self, run: Path) -> SlatVae:
        """Frozen, with its trained or imported weights. ModelError."""
        vae = SlatVae(self.section.network)
        if isinstance(self.section, ImportedSlatVae):
            load_slat_vae(self.section.weights, vae.encoder, vae.surface)
        else:
            self.load_trained(run, vae)
        return vae.eval().requires_grad_(False)

    def inputs(self, data: ComponentData, image: FeatureEncoder | None, device: torch.device) -> ObjectInputs:
        """What the encoder reads of true objects; `image`: the image encoder where it is there already. ModelError."""
        features, network = self.section.features, self.section.network
        if isinstance(features, SurfaceFeatures):
            return ObjectInputs(of_views=None)
        if image is None:
            image = image_encoder(self.encoders).to(device, torch.float32)
        encoder = view_encoder(image)
        if encoder.encoder.channels != network.feature_channels:
            raise ModelError(
                "slat_vae.network.feature_channels",
                f"is {network.feature_channels}, encoders.image gives {encoder.encoder.channels} channels",
                expected="the same",
                action=f"Set it to {encoder.encoder.channels}, or choose the other encoder.",
            )
        meshes = ObjectMeshes(shards=data.training.index.shards)
        views = ViewFeatures(meshes=meshes, encoder=encoder, config=features, device=device)
        return ObjectInputs(of_views=views)
