"""The parts of stage 1, trained one after the other: VAE, hand encoder, dual-branch flow.

RUN/vae, RUN/hand_encoder, RUN/stage_one    checkpoints, TensorBoard logs, figures.json
RUN/hand_encoder/hand_encoder.{safetensors,json}    its averaged weights in float16, for `load_hand_net`
"""

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import torch
from accelerate import Accelerator
from jaxtyping import Bool
from torch import Tensor, nn

from model.config import (
    ImportedVae,
    PackagedHandEncoder,
    Recipe,
    StageOnePart,
    TrainingConfig,
    VaePart,
    as_yaml,
)
from model.data import ShardStream, open_motions, validation_config
from model.encoders.aggregator import AggregatorConfig, FeatureAggregator
from model.encoders.cached import CachedEncoder
from model.encoders.dino import DinoConfig, load_dino
from model.encoders.efficientnet import load_efficientnet
from model.encoders.hand import HandEncoder, HandNet, packaged_hand_net, save_hand_net
from model.encoders.hand_training import HandTask
from model.encoders.protocol import FeatureEncoder
from model.encoders.wilor import WilorConfig, load_wilor
from model.errors import ModelError
from model.evaluation.overlap import mean_shape
from model.flow import Guidance
from model.networks.lora import add_lora
from model.sample import Batch
from model.sparse_structure.dual_branch import DualBranchFlow
from model.sparse_structure.stage_one import StageOne, StageOneConfig, StageOneTask
from model.sparse_structure.vae import StructureVae
from model.sparse_structure.vae_training import VaeTask
from model.stream_config import StreamConfig
from model.training.checkpoint import latest_checkpoint, load_average
from model.training.identity import part_sha256
from model.training.source import StreamSource
from model.training.task import Evaluation, Task
from model.training.trainer import StepReport, train
from model.weights.weight_file import VAE, load_start, load_weights

__all__ = ["PARTS", "load_stage_one", "train_part", "trained_parts"]

PARTS = ("vae", "hand_encoder", "stage_one")


def trained_parts(config: TrainingConfig) -> tuple[str, ...]:
    """The parts that this configuration trains, in order; the others have weights already."""
    given = {"vae": isinstance(config.vae, ImportedVae), "hand_encoder": config.hand_encoder is None}
    return tuple(name for name in PARTS if not given.get(name))


@dataclass(frozen=True, kw_only=True)
class _Data:
    """Streams of one part."""

    training: StreamSource
    held_out: StreamConfig
    batches: int

    def validation(self) -> Iterator[Batch]:
        """The same held-out views every time."""
        stream = ShardStream(self.held_out)
        try:
            yield from islice(stream, self.batches)
        finally:
            stream.close()


def train_part(
    name: str,
    config: TrainingConfig,
    folder: Path,
    *,
    accelerator: Accelerator,
    report: Callable[[StepReport], None],
) -> dict[str, float]:
    """Train one part (see PARTS) and give its figures on held-out cameras. Earlier parts must be trained.

    Continues where it was stopped. ModelError when an earlier part is missing or of another configuration.
    """
    recipe = _recipe(name, config)
    data = _data(config, recipe, accelerator)
    task = _task(name, config, folder, accelerator.device)
    last: list[Evaluation] = []

    def validate() -> Evaluation:
        last[:] = [_evaluate(task, data.validation(), accelerator.device)]
        return last[0]

    train(
        task,
        data.training,
        recipe.trainer,
        recipe.optimizer,
        folder=folder / name,
        config_yaml=as_yaml(config),
        config_sha256=part_sha256(name, config),
        validate=validate,
        report=report,
        accelerator=accelerator,
    )
    path = folder / name / "figures.json"
    if not last and not path.exists():  # stopped between the last checkpoint and the figures
        _load(folder, name, config, task.module)
        validate()
    if last and accelerator.is_main_process:
        if isinstance(task, HandTask):
            _load(folder, name, config, task.network)
            save_hand_net(task.network, folder / name, dtype=torch.float16)
        path.write_text(json.dumps(last[0].figures, indent=2), encoding="utf-8")
    accelerator.wait_for_everyone()
    figures: dict[str, float] = json.loads(path.read_text(encoding="utf-8"))
    return figures


def load_stage_one(config: TrainingConfig, folder: Path, device: torch.device) -> StageOneTask:
    """Stage 1 with the averaged weights of its newest checkpoint, for inference."""
    task = _stage_one_task(config, folder, device)
    _load(folder, "stage_one", config, task.module)
    task.module.to(device).eval()
    return task


def _evaluate(task: Task, batches: Iterable[Batch], device: torch.device) -> Evaluation:
    return task.evaluate(task.module, (batch.to(device, torch.float32) for batch in batches))


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


def _data(config: TrainingConfig, recipe: Recipe, accelerator: Accelerator) -> _Data:
    stream = replace(
        config.data, batch_size=recipe.batch_size, views=recipe.views, image_size=recipe.image_size
    )
    split = config.validation.split
    held_out = validation_config(
        stream,
        split=split,
        cameras="held_out" if split == stream.split else "all",
        views=config.validation.views,
        batch_size=config.validation.batch_size,
    )
    return _Data(
        training=StreamSource(
            config=stream,
            index=open_motions(stream),
            rank=accelerator.process_index,
            ranks=accelerator.num_processes,
        ),
        held_out=replace(held_out, workers=0, samples_per_motion=config.validation.samples_per_motion),
        batches=config.validation.batches,
    )


def _task(name: str, config: TrainingConfig, folder: Path, device: torch.device) -> Task:
    torch.manual_seed(_recipe(name, config).trainer.seed)  # of the initial weights
    if name == "vae":
        assert isinstance(config.vae, VaePart)  # else there is no recipe
        network = StructureVae(config.vae.network)
        return VaeTask(network=network, config=config.vae.network, turn=config.vae.turn)
    if name == "hand_encoder":
        assert config.hand_encoder is not None  # else there is no recipe
        return HandTask(network=HandNet(config.hand_encoder.network), config=config.hand_encoder.loss)
    return _stage_one_task(config, folder, device)


def _stage_one_task(config: TrainingConfig, folder: Path, device: torch.device) -> StageOneTask:
    part = config.stage_one
    vae = _vae(config, folder).to(device)
    shapes = _training_shapes(config)
    image, hand = _image_encoder(config), _hand_encoder(config, folder)
    image.to(device, torch.float32)
    hand.to(device, torch.float32)
    aggregator = FeatureAggregator(
        AggregatorConfig(
            image_channels=image.channels,
            image_grid=image.grid,
            hand_channels=hand.channels,
            hand_grid=hand.grid,
            hand_width=part.hand_width,
            hidden=part.hidden,
            channels=part.network.masks.feature_channels,
        )
    )
    network = StageOne(aggregator, DualBranchFlow(part.network))
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
            latent_scale=part.start.latent_scale if part.start else _latent_scale(vae, shapes, device),
        ),
        mean_shape=mean_shape(shapes),
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


def _training_shapes(config: TrainingConfig) -> Bool[Tensor, "shape 64 64 64"]:
    """Occupancies of the first 128 motions of the training data."""
    stream = replace(
        config.data, batch_size=8, views=(1, 1), image_size=32, endless=False, workers=0, samples_per_motion=1
    )
    return torch.cat([batch.occupancy for batch in islice(ShardStream(stream), 16)])


@torch.no_grad()
def _latent_scale(vae: StructureVae, shapes: Bool[Tensor, "shape 64 64 64"], device: torch.device) -> float:
    """Root mean square of the latents of the training shapes: the flow starts from unit noise."""
    squares = [vae.encoder(part.to(device)).mean.square().mean((1, 2, 3, 4)) for part in shapes.split(8)]
    return float(torch.cat(squares).mean().sqrt())


def _image_encoder(config: TrainingConfig) -> FeatureEncoder:
    chosen = config.encoders.image
    encoder: FeatureEncoder = (
        load_dino(chosen) if isinstance(chosen, DinoConfig) else load_efficientnet(chosen)
    )
    return _cached(encoder, config)


def _hand_encoder(config: TrainingConfig, folder: Path) -> FeatureEncoder:
    chosen = config.encoders.hand
    if isinstance(chosen, WilorConfig):
        return _cached(load_wilor(chosen), config)
    if isinstance(chosen, PackagedHandEncoder):
        return _cached(HandEncoder(network=packaged_hand_net(), grid=chosen.packaged_grid), config)
    assert config.hand_encoder is not None  # TrainingConfig sees to it
    network = HandNet(config.hand_encoder.network)
    _load(folder, "hand_encoder", config, network)
    network.eval().requires_grad_(False)
    return _cached(HandEncoder(network=network, grid=chosen.own_grid), config)


def _cached(encoder: FeatureEncoder, config: TrainingConfig) -> FeatureEncoder:
    views = config.encoders.cached_views
    return CachedEncoder(encoder=encoder, max_views=views) if views else encoder


def _load(folder: Path, name: str, config: TrainingConfig, module: nn.Module) -> None:
    """Averaged weights of a trained part. ModelError when it is missing or of another configuration."""
    path = latest_checkpoint(folder / name / "checkpoints")
    if path is None:
        raise ModelError(
            folder / name,
            "holds no checkpoint",
            expected=f"the trained {name}",
            action=f"Train it first: forehoi train {name}.",
        )
    state = load_average(path, module)
    if state.config_sha256 != (ours := part_sha256(name, config)):
        raise ModelError(
            path,
            f"was trained with another configuration ({state.config_sha256[:12]})",
            expected=f"configuration {ours[:12]}",
            action=f"Train the {name} of this configuration into another folder (--out).",
        )
