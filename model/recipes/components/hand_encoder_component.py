"""The open hand encoder, where a configuration trains one.

RUN/hand_encoder/hand_encoder.{safetensors,json}    its averaged weights in float16, for `load_hand_net`
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import torch

from model.data.config import DataConfig
from model.encoders.hand import HandNet, HandNetConfig, save_hand_net
from model.encoders.hand_training import HandLossConfig, HandTask
from model.recipes.components.component import Component
from model.recipes.components.component_data import ComponentData
from model.recipes.components.component_identity import as_yaml, deciding_data, deciding_recipe, sha256_of
from model.recipes.components.recipe import ImageRecipe
from model.training.checkpoint import latest_checkpoint

__all__ = ["HandEncoderComponent", "TrainedHandEncoder"]


@dataclass(frozen=True, kw_only=True)
class TrainedHandEncoder:
    """The open hand encoder, trained here."""

    network: HandNetConfig
    loss: HandLossConfig
    recipe: ImageRecipe


@dataclass(frozen=True, kw_only=True)
class HandEncoderComponent(Component):
    """The hand encoder of a configuration."""

    name: ClassVar[str] = "hand_encoder"
    section: TrainedHandEncoder
    data: DataConfig

    @property
    def recipe(self) -> ImageRecipe:
        return self.section.recipe

    def sha256(self) -> str:
        section = replace(self.section, recipe=deciding_recipe(self.section.recipe))
        return sha256_of(as_yaml(section), as_yaml(deciding_data(self.data)))

    def task(self, run: Path, data: ComponentData, device: torch.device) -> HandTask:  # noqa: ARG002
        return HandTask(network=HandNet(self.section.network), config=self.section.loss)

    def load(self, run: Path) -> HandNet:
        """Frozen, with its trained weights. ModelError."""
        network = HandNet(self.section.network)
        self.load_trained(run, network)
        return network.eval().requires_grad_(False)

    def exports(self, run: Path) -> tuple[Path, ...]:
        """The network as `load_hand_net` reads it; written when a checkpoint is newer than what is there."""
        folder = run / self.name
        file, newest = folder / "hand_encoder.safetensors", latest_checkpoint(folder / "checkpoints")
        if newest is not None and (not file.exists() or file.stat().st_mtime < newest.stat().st_mtime):
            save_hand_net(self.load(run), folder, dtype=torch.float16)
        return (file,)
