"""Trained networks of both stages out of the folders of their trainings.

Opening a run tells what is missing, and reads its weights once for their digests; loading it takes seconds.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar

import torch

from model.encoders.hand import HandNet, packaged_hand_net
from model.errors import ModelError
from model.recipes.components.recipe import Recipe
from model.recipes.components.slat_flow_component import SlatFlowComponent
from model.recipes.components.stage_one_component import StageOneComponent
from model.recipes.config import PRESETS, TrainingConfig, parse_config
from model.recipes.stage_one_config import StageOneTrainingConfig
from model.recipes.stage_two_config import StageTwoTrainingConfig
from model.sparse_structure.stage_one import StageOneTask
from model.structured_latent.flow_training import SlatFlowTask
from model.training.checkpoint import latest_checkpoint, read_state
from shards.configuration.presets import preset_names

__all__ = [
    "Checkpoint",
    "Networks",
    "StageOneNetworks",
    "StageOneRun",
    "StageTwoNetworks",
    "StageTwoRun",
    "load_networks",
    "open_stage_one",
    "open_stage_two",
]

_Config = TypeVar("_Config", StageOneTrainingConfig, StageTwoTrainingConfig)
_AVERAGE = "average.safetensors"  # what inference uses of a checkpoint


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """Weights that decide a result."""

    component: str
    path: Path
    step: int
    steps: int  # of the whole training
    config_sha256: str
    weights_sha256: str


@dataclass(frozen=True, kw_only=True)
class StageOneRun:
    """A training of stage 1 that can be loaded."""

    folder: Path
    config: StageOneTrainingConfig
    checkpoints: tuple[Checkpoint, ...]


@dataclass(frozen=True, kw_only=True)
class StageTwoRun:
    """A training of stage 2 that can be loaded."""

    folder: Path
    config: StageTwoTrainingConfig
    checkpoints: tuple[Checkpoint, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class StageOneNetworks:
    """Stage 1, and the images that it was trained on."""

    task: StageOneTask
    hand: HandNet  # finds the joints that a crop must hold
    image_size: int  # px
    crop_margin: float  # side of a crop over the longest side of the box around hand and object


@dataclass(frozen=True, kw_only=True, eq=False)
class StageTwoNetworks:
    """Stage 2, and the images that it was trained on."""

    task: SlatFlowTask
    image_size: int  # px


@dataclass(frozen=True, kw_only=True, eq=False)
class Networks:
    """What `reconstruct` runs; without stage 2 it ends with masks and voxels."""

    stage_one: StageOneNetworks
    stage_two: StageTwoNetworks | None
    device: torch.device
    checkpoints: tuple[Checkpoint, ...]


def open_stage_one(run: Path) -> StageOneRun:
    """ModelError, naming the command that trains it, when the folder holds no trained stage 1."""
    config = _config(run, StageOneComponent.name, StageOneTrainingConfig, stage=1)
    return StageOneRun(folder=run, config=config, checkpoints=_checkpoints(run, config, stage=1))


def open_stage_two(run: Path) -> StageTwoRun:
    """ModelError, naming the command that trains it, when the folder holds no trained stage 2."""
    config = _config(run, SlatFlowComponent.name, StageTwoTrainingConfig, stage=2)
    return StageTwoRun(folder=run, config=config, checkpoints=_checkpoints(run, config, stage=2))


def load_networks(one: StageOneRun, two: StageTwoRun | None, device: torch.device) -> Networks:
    """Averaged weights, ready for inference. ModelError, ShardError."""
    task = one.config.flow.load(one.folder, device)
    stage_one = StageOneNetworks(
        task=task,
        # Where stage 1 looks through another kind of hand encoder, the packaged one finds the hand.
        hand=(task.hand_net or packaged_hand_net()).to(device),
        image_size=one.config.stage_one.recipe.image_size,
        crop_margin=one.config.data.augmentation.switched_off().margin[0],
    )
    stage_two = None
    if two is not None:
        stage_two = StageTwoNetworks(
            task=two.config.flow.load(two.folder, device),
            image_size=two.config.slat_flow.recipe.image_size,
        )
    checkpoints = (*one.checkpoints, *(two.checkpoints if two is not None else ()))
    return Networks(stage_one=stage_one, stage_two=stage_two, device=device, checkpoints=checkpoints)


def _config(run: Path, name: str, kind: type[_Config], *, stage: Literal[1, 2]) -> _Config:
    """The configuration that the newest checkpoint of a component was trained with."""
    path = _newest(run, name, stage)
    config = parse_config(read_state(path).config_yaml, where=f"{path}/state.json")
    if not isinstance(config, kind):
        raise ModelError(
            path,
            "was trained with a configuration of the other stage",
            expected=f"a training of stage {stage}",
            action="Check the path.",
        )
    return config


def _checkpoints(run: Path, config: TrainingConfig, *, stage: Literal[1, 2]) -> tuple[Checkpoint, ...]:
    """Of all components that the configuration trains."""
    trained = ((component.name, component.recipe) for component in config.components())
    return tuple(
        _checkpoint(_newest(run, name, stage), name, recipe) for name, recipe in trained if recipe is not None
    )


def _checkpoint(path: Path, name: str, recipe: Recipe) -> Checkpoint:
    state = read_state(path)
    with (path / _AVERAGE).open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return Checkpoint(
        component=name,
        path=path,
        step=state.step,
        steps=recipe.trainer.steps,
        config_sha256=state.config_sha256,
        weights_sha256=digest,
    )


def _newest(run: Path, name: str, stage: Literal[1, 2]) -> Path:
    path = latest_checkpoint(run / name / "checkpoints")
    if path is None:
        otherwise = {1: ".", 2: "; or stop after the voxels: --stages one."}
        raise ModelError(
            run / name,
            "holds no checkpoint",
            expected=f"a trained stage {stage}",
            action=f"Train it first: forehoi train {_config_of(run)} --out {run}{otherwise[stage]}",
        )
    return path


def _config_of(run: Path) -> str:
    """The preset that trains a run of this name, as far as there is one."""
    return run.name if run.name in preset_names(PRESETS) else "CONFIG"
