"""The sparse-structure VAE of stage 1: trained here, or imported."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import torch

from model.data.config import DataConfig
from model.recipes.components.component import Component
from model.recipes.components.component_data import ComponentData
from model.recipes.components.component_identity import as_yaml, deciding_data, deciding_recipe, sha256_of
from model.recipes.components.recipe import Recipe
from model.sparse_structure.vae import StructureVae, VaeConfig
from model.sparse_structure.vae_training import VaeTask
from model.weights.weight_file import VAE, load_weights, weights_sha256

__all__ = ["ImportedVae", "TrainedVae", "VaeComponent"]


@dataclass(frozen=True, kw_only=True)
class TrainedVae:
    """The VAE, trained here; `turn`: on shapes in all 48 orientations of the cube."""

    network: VaeConfig
    turn: bool
    recipe: Recipe


@dataclass(frozen=True, kw_only=True)
class ImportedVae:
    """The VAE with weights that are there already."""

    network: VaeConfig
    weights: Path  # made by `forehoi weights import`


@dataclass(frozen=True, kw_only=True)
class VaeComponent(Component):
    """The VAE of a configuration."""

    name: ClassVar[str] = "vae"
    section: TrainedVae | ImportedVae
    data: DataConfig

    @property
    def recipe(self) -> Recipe | None:
        return self.section.recipe if isinstance(self.section, TrainedVae) else None

    def sha256(self) -> str:
        if isinstance(self.section, ImportedVae):
            return sha256_of(as_yaml(self.section), weights_sha256(self.section.weights))
        section = replace(self.section, recipe=deciding_recipe(self.section.recipe))
        return sha256_of(as_yaml(section), as_yaml(deciding_data(self.data)))

    def task(self, run: Path, data: ComponentData, device: torch.device) -> VaeTask:  # noqa: ARG002
        assert isinstance(self.section, TrainedVae)  # else it has no recipe
        network = StructureVae(self.section.network)
        return VaeTask(network=network, config=self.section.network, turn=self.section.turn)

    def load(self, run: Path) -> StructureVae:
        """Frozen, with its trained or imported weights. ModelError."""
        vae = StructureVae(self.section.network)
        if isinstance(self.section, ImportedVae):
            load_weights(self.section.weights, vae, group=VAE)
        else:
            self.load_trained(run, vae)
        return vae.eval().requires_grad_(False)
