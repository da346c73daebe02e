"""Component: one network that is trained on its own, whatever stage it is of.

RUN/<name>/checkpoints, RUN/<name>/tensorboard, RUN/<name>/metrics.json    what its training leaves
"""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import ClassVar

import torch
from torch import nn

from model.errors import ModelError
from model.recipes.components.component_data import ComponentData
from model.recipes.components.recipe import Recipe
from model.training.checkpoint import latest_checkpoint, load_average, read_state, require_data
from model.training.task import Task

__all__ = ["Component"]


class Component(ABC):
    """What a section of a configuration describes: a network, and how it is trained or where its weights are."""

    name: ClassVar[str]  # of its section, and of its folder in a run
    reads_surfaces: ClassVar[bool] = False  # whether it is trained on the objects' surface samples

    @property
    @abstractmethod
    def recipe(self) -> Recipe | None:
        """How it is trained; None: its weights are imported."""

    @property
    def stands_on(self) -> "tuple[Component, ...]":
        """The components that it stands on, whose weights it uses and leaves as they are."""
        return ()

    @abstractmethod
    def sha256(self) -> str:
        """Changes with anything that decides its weights. ModelError when a weight file is missing."""

    @abstractmethod
    def task(self, run: Path, data: ComponentData, device: torch.device) -> Task:
        """What the trainer trains, with initial weights from torch's global generator.

        ModelError when a component that it stands on is not trained, or of another configuration.
        """

    def exports(self, run: Path) -> tuple[Path, ...]:  # noqa: ARG002
        """Files for other uses than training, made of its averaged weights unless they are there; none by default."""
        return ()

    def load_trained(self, run: Path, module: nn.Module) -> None:
        """Put its averaged weights into `module`; needs no data.

        ModelError when it is not trained, or with another configuration.
        """
        path = latest_checkpoint(run / self.name / "checkpoints")
        if path is None:
            raise ModelError(
                run / self.name,
                "holds no checkpoint",
                expected=f"the trained {self.name}",
                action=f"Train it first: forehoi train {self.name}.",
            )
        found, expected = read_state(path).config_sha256, self.sha256()
        if found != expected:
            raise ModelError(
                path,
                f"was trained with another configuration ({found[:12]})",
                expected=f"configuration {expected[:12]}",
                action=f"Train the {self.name} of this configuration into another folder (--out).",
            )
        load_average(path, module)

    def require_same_data(self, run: Path, data: ComponentData) -> None:
        """ModelError when it is trained, but on other data."""
        path = latest_checkpoint(run / self.name / "checkpoints")
        if self.recipe is not None and path is not None:
            require_data(path, read_state(path), data.training.data_sha256)
