"""Trained networks of both stages out of the folders of their trainings.

Opening a run tells what is missing, and reads its weights once for their digests; loading it takes seconds.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import torch

from model.encoders.hand import HandNet, packaged_hand_net
from model.errors import ModelError
from model.recipes.components import load_stage_one, trained_parts
from model.recipes.config import PRESETS, TrainingConfig
from model.recipes.slat_components import SLAT_PARTS, load_slat_flow, trained_slat_parts
from model.recipes.slat_config import SlatTrainingConfig, parse_any_config
from model.sparse_structure.stage_one import StageOneTask
from model.structured_latent.flow_training import SlatFlowTask
from model.training.checkpoint import latest_checkpoint, read_state
from model.training.config import TrainerConfig
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

_AVERAGE = "average.safetensors"  # what inference uses of a checkpoint


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """Weights that decide a result."""

    part: str
    path: Path
    step: int
    steps: int  # of the whole training
    config_sha256: str
    weights_sha256: str


@dataclass(frozen=True, kw_only=True)
class StageOneRun:
    """A training of stage 1 that can be loaded."""

    folder: Path
    config: TrainingConfig
    checkpoints: tuple[Checkpoint, ...]


@dataclass(frozen=True, kw_only=True)
class StageTwoRun:
    """A training of stage 2 that can be loaded."""

    folder: Path
    config: SlatTrainingConfig
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
    config = _config(run, "stage_one")
    assert isinstance(config, TrainingConfig)  # what trains the part of this name
    recipes = {"vae": config.vae, "hand_encoder": config.hand_encoder, "stage_one": config.stage_one}
    return StageOneRun(
        folder=run,
        config=config,
        checkpoints=tuple(
            _checkpoint(run, part, recipes[part].recipe.trainer)  # type: ignore[union-attr]
            for part in trained_parts(config)
        ),
    )


def open_stage_two(run: Path) -> StageTwoRun:
    """ModelError, naming the command that trains it, when the folder holds no trained stage 2."""
    config = _config(run, "slat_flow")
    assert isinstance(config, SlatTrainingConfig)
    recipes = {"slat_vae": config.slat_vae, "slat_flow": config.slat_flow}
    return StageTwoRun(
        folder=run,
        config=config,
        checkpoints=tuple(
            _checkpoint(run, part, recipes[part].recipe.trainer)  # type: ignore[union-attr]
            for part in trained_slat_parts(config)
        ),
    )


def load_networks(one: StageOneRun, two: StageTwoRun | None, device: torch.device) -> Networks:
    """Averaged weights, ready for inference. ModelError, ShardError."""
    task = load_stage_one(one.config, one.folder, device)
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
            task=load_slat_flow(two.config, two.folder, device),
            image_size=two.config.slat_flow.recipe.image_size,
        )
    checkpoints = (*one.checkpoints, *(two.checkpoints if two is not None else ()))
    return Networks(stage_one=stage_one, stage_two=stage_two, device=device, checkpoints=checkpoints)


def _config(run: Path, part: str) -> TrainingConfig | SlatTrainingConfig:
    """The configuration that the newest checkpoint of a part was trained with."""
    path = _newest(run, part)
    return parse_any_config(read_state(path).config_yaml, where=f"{path}/state.json")


def _checkpoint(run: Path, part: str, trainer: TrainerConfig) -> Checkpoint:
    path = _newest(run, part)
    state = read_state(path)
    with (path / _AVERAGE).open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return Checkpoint(
        part=part,
        path=path,
        step=state.step,
        steps=trainer.steps,
        config_sha256=state.config_sha256,
        weights_sha256=digest,
    )


def _newest(run: Path, part: str) -> Path:
    path = latest_checkpoint(run / part / "checkpoints")
    if path is None:
        is_second = part in SLAT_PARTS
        raise ModelError(
            run / part,
            "holds no checkpoint",
            expected=f"a trained stage {2 if is_second else 1}",
            action=f"Train it first: forehoi train {_config_of(run)} --out {run}"
            + ("; or stop after the voxels: --stages one." if is_second else "."),
        )
    return path


def _config_of(run: Path) -> str:
    """The preset that trains a run of this name, as far as there is one."""
    return run.name if run.name in preset_names(PRESETS) else "CONFIG"
