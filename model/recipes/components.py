"""The parts of stage 1, trained one after the other: VAE, hand encoder, dual-branch flow.

RUN/vae, RUN/hand_encoder, RUN/stage_one    checkpoints, TensorBoard logs, metrics.json
RUN/stage_one/dataset_statistics.safetensors    what stage 1 needs of the training data when it is used
RUN/hand_encoder/hand_encoder.{safetensors,json}    its averaged weights in float16, for `load_hand_net`
"""

from collections.abc import Callable
from itertools import islice
from pathlib import Path

import torch
from accelerate import Accelerator
from jaxtyping import Bool
from torch import Tensor, nn

from model.data.stream import ShardStream
from model.encoders.hand import HandEncoder, HandNet, save_hand_net
from model.encoders.hand_training import HandTask
from model.encoders.protocol import FeatureEncoder
from model.errors import ModelError
from model.evaluation.overlap import mean_shape
from model.flow import Guidance
from model.networks.lora import add_lora
from model.recipes.component_identity import part_sha256
from model.recipes.component_run import load_part, one_pass, part_data, require_same_data, run_part
from model.recipes.config import (
    ImportedVae,
    OwnHandEncoder,
    Recipe,
    StageOnePart,
    TrainingConfig,
    VaePart,
    as_yaml,
)
from model.recipes.dataset_statistics import DatasetStatistics, load_statistics, statistics_of_run
from model.recipes.frozen_encoders import aggregator_over, given_hand_encoder, image_encoder, with_cache
from model.sparse_structure.stage_one import StageOne, StageOneConfig, StageOneTask
from model.sparse_structure.vae import StructureVae
from model.sparse_structure.vae_training import VaeTask
from model.training.checkpoint import latest_checkpoint
from model.training.task import Task
from model.training.trainer import TrainingEvent
from model.weights.weight_file import VAE, load_start, load_weights

__all__ = ["PARTS", "load_stage_one", "train_part", "trained_parts"]

PARTS = ("vae", "hand_encoder", "stage_one")


def trained_parts(config: TrainingConfig) -> tuple[str, ...]:
    """The parts that this configuration trains, in order; the others have weights already."""
    given = {"vae": isinstance(config.vae, ImportedVae), "hand_encoder": config.hand_encoder is None}
    return tuple(name for name in PARTS if not given.get(name))


def train_part(
    name: str,
    config: TrainingConfig,
    folder: Path,
    *,
    accelerator: Accelerator,
    report: Callable[[TrainingEvent], None],
) -> dict[str, float]:
    """Train one part (see PARTS) and give its metrics on held-out cameras. Earlier parts must be trained.

    Continues where it was stopped. ModelError when an earlier part is missing, of another configuration or of
    other data.
    """
    recipe = _recipe(name, config)
    data = part_data(config.data, config.validation, recipe, accelerator)
    for earlier in trained_parts(config)[: trained_parts(config).index(name)]:
        require_same_data(folder / earlier, data)
    task = _task(name, config, folder, accelerator.device)
    metrics = run_part(
        task,
        data,
        recipe,
        folder / name,
        config_yaml=as_yaml(config),
        config_sha256=part_sha256(name, config),
        accelerator=accelerator,
        report=report,
    )
    if isinstance(task, HandTask) and accelerator.is_main_process:
        _export_hand_net(task.network, config, folder)
    return metrics


def _export_hand_net(network: HandNet, config: TrainingConfig, folder: Path) -> None:
    """The averaged weights, for `load_hand_net`; only when the run is newer than what is there."""
    export = folder / "hand_encoder" / "hand_encoder.safetensors"
    newest = latest_checkpoint(folder / "hand_encoder" / "checkpoints")
    if newest is not None and (not export.exists() or export.stat().st_mtime < newest.stat().st_mtime):
        _load(folder, "hand_encoder", config, network)
        save_hand_net(network, folder / "hand_encoder", dtype=torch.float16)


def load_stage_one(config: TrainingConfig, folder: Path, device: torch.device) -> StageOneTask:
    """Stage 1 with the averaged weights of its newest checkpoint, for inference."""
    task = _stage_one_task(config, folder, device, load_statistics(folder / "stage_one"))
    _load(folder, "stage_one", config, task.module)
    task.module.to(device).eval()
    return task


def _recipe(name: str, config: TrainingConfig) -> Recipe:
    part = {"vae": config.vae, "hand_encoder": config.hand_encoder, "stage_one": config.stage_one}[name]
    if part is None or isinstance(part, ImportedVae):
        raise ModelError(
            f"{config.name}: {name}",
            "has weights already, there is nothing to train",
            expected=f"one of {', '.join(trained_parts(config))}",
            action="Train one of these, or give a configuration with a recipe for it.",
        )
    return part.recipe


def _task(name: str, config: TrainingConfig, folder: Path, device: torch.device) -> Task:
    torch.manual_seed(_recipe(name, config).trainer.seed)  # of the initial weights
    if name == "vae":
        assert isinstance(config.vae, VaePart)  # else there is no recipe
        network = StructureVae(config.vae.network)
        return VaeTask(network=network, config=config.vae.network, turn=config.vae.turn)
    if name == "hand_encoder":
        assert config.hand_encoder is not None  # else there is no recipe
        return HandTask(network=HandNet(config.hand_encoder.network), config=config.hand_encoder.loss)
    return _stage_one_task(config, folder, device, None)


def _stage_one_task(
    config: TrainingConfig, folder: Path, device: torch.device, statistics: DatasetStatistics | None
) -> StageOneTask:
    """`statistics` None: those of a run that begins or goes on, measured once on the training data."""
    part = config.stage_one
    vae = _vae(config, folder).to(device)
    if statistics is None:
        statistics = statistics_of_run(folder / "stage_one", lambda: _measured(config, vae, device))
    image, hand = image_encoder(config.encoders), _hand_encoder(config, folder)
    image.to(device, torch.float32)
    hand.to(device, torch.float32)
    aggregator = aggregator_over(
        image,
        hand,
        hand_width=part.hand_width,
        hidden=part.hidden,
        channels=part.network.masks.feature_channels,
    )
    network = StageOne(aggregator, part.network)
    _start(network, part)
    return StageOneTask(
        network=network,
        image_encoder=image,
        hand_encoder=hand,
        vae=vae,
        config=StageOneConfig(
            beta=part.beta,
            drop_condition=part.drop_condition,
            time=part.time,
            sampler=part.sampler,
            guidance=Guidance(strength={"geometry": part.guidance_strength}, interval=part.guidance_interval),
            latent_scale=statistics.latent_scale,
        ),
        mean_shape=statistics.mean_shape,
    )


def _start(network: StageOne, part: StageOnePart) -> None:
    """Weights to start from, then adapters on them."""
    if part.start is not None:
        load_start(part.start.weights, network)
    if part.lora is not None:
        add_lora(network.flow.geometry, part.lora)


def _vae(config: TrainingConfig, folder: Path) -> StructureVae:
    """The frozen VAE, imported or trained."""
    vae = StructureVae(config.vae.network)
    if isinstance(config.vae, ImportedVae):
        load_weights(config.vae.weights, vae, group=VAE)
    else:
        _load(folder, "vae", config, vae)
    return vae.eval().requires_grad_(False)


def _measured(config: TrainingConfig, vae: StructureVae, device: torch.device) -> DatasetStatistics:
    shapes, start = _training_shapes(config), config.stage_one.start
    return DatasetStatistics(
        latent_scale=start.latent_scale if start else _latent_scale(vae, shapes, device),
        mean_shape=mean_shape(shapes),
    )


def _training_shapes(config: TrainingConfig) -> Bool[Tensor, "shape 64 64 64"]:
    """Occupancies of the first 128 motions of the training data."""
    return torch.cat([batch.occupancy for batch in islice(ShardStream(one_pass(config.data, 8)), 16)])


@torch.no_grad()
def _latent_scale(vae: StructureVae, shapes: Bool[Tensor, "shape 64 64 64"], device: torch.device) -> float:
    """Root mean square of the latents of the training shapes: the flow starts from unit noise."""
    squares = [vae.encoder(part.to(device)).mean.square().mean((1, 2, 3, 4)) for part in shapes.split(8)]
    return float(torch.cat(squares).mean().sqrt())


def _hand_encoder(config: TrainingConfig, folder: Path) -> FeatureEncoder:
    chosen = config.encoders.hand
    if not isinstance(chosen, OwnHandEncoder):
        return given_hand_encoder(config.encoders)
    assert config.hand_encoder is not None  # TrainingConfig sees to it
    network = HandNet(config.hand_encoder.network)
    _load(folder, "hand_encoder", config, network)
    network.eval().requires_grad_(False)
    return with_cache(HandEncoder(network=network, grid=chosen.own_grid), config.encoders)


def _load(folder: Path, name: str, config: TrainingConfig, module: nn.Module) -> None:
    """Averaged weights of a trained part. ModelError when it is missing or of another configuration."""
    load_part(folder / name, module, config_sha256=part_sha256(name, config))
