"""The parts of stage 1, trained one after the other: VAE, hand encoder, dual-branch flow.

RUN/vae, RUN/hand_encoder, RUN/stage_one    checkpoints, TensorBoard logs, figures.json
"""

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import torch
from accelerate import Accelerator
from torch import nn

from model.config import OwnHandEncoder, Recipe, TrainingConfig, as_yaml, part_sha256
from model.data import ShardStream, open_motions, validation_config
from model.encoders.aggregator import AggregatorConfig, FeatureAggregator
from model.encoders.cached import CachedEncoder
from model.encoders.dino import DinoConfig, load_dino
from model.encoders.efficientnet import load_efficientnet
from model.encoders.hand import HandEncoder, HandNet
from model.encoders.hand_training import HandTask
from model.encoders.protocol import FeatureEncoder
from model.encoders.wilor import load_wilor
from model.errors import ModelError
from model.flow import Guidance
from model.sample import Batch
from model.sparse_structure.dual_branch import DualBranchFlow
from model.sparse_structure.stage_one import StageOne, StageOneConfig, StageOneTask
from model.sparse_structure.vae import StructureVae
from model.sparse_structure.vae_training import VaeTask
from model.stream_config import StreamConfig
from model.training.checkpoint import latest_checkpoint, load_average
from model.training.source import StreamSource
from model.training.task import Evaluation, Task
from model.training.trainer import StepReport, train

__all__ = ["PARTS", "load_stage_one", "train_part"]

PARTS = ("vae", "hand_encoder", "stage_one")


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
        config_sha256=_sha256(name, config),
        validate=validate,
        report=report,
        accelerator=accelerator,
    )
    path = folder / name / "figures.json"
    if last and accelerator.is_main_process:
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
    if name == "vae":
        return config.vae.recipe
    return config.hand_encoder.recipe if name == "hand_encoder" else config.stage_one.recipe


def _data(config: TrainingConfig, recipe: Recipe, accelerator: Accelerator) -> _Data:
    stream = replace(
        config.data, batch_size=recipe.batch_size, views=recipe.views, image_size=recipe.image_size
    )
    held_out = validation_config(
        stream,
        split=stream.split,
        cameras="held_out",
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
        held_out=replace(held_out, workers=0),
        batches=config.validation.batches,
    )


def _task(name: str, config: TrainingConfig, folder: Path, device: torch.device) -> Task:
    torch.manual_seed(_recipe(name, config).trainer.seed)  # of the initial weights
    if name == "vae":
        return VaeTask(network=StructureVae(config.vae.network), config=config.vae.network)
    if name == "hand_encoder":
        return HandTask(network=HandNet(config.hand_encoder.network), config=config.hand_encoder.loss)
    return _stage_one_task(config, folder, device)


def _stage_one_task(config: TrainingConfig, folder: Path, device: torch.device) -> StageOneTask:
    part = config.stage_one
    vae = StructureVae(config.vae.network)
    _load(folder, "vae", config, vae)
    vae.to(device).eval().requires_grad_(False)
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
    return StageOneTask(
        network=StageOne(aggregator, DualBranchFlow(part.network)),
        image_encoder=image,
        hand_encoder=hand,
        vae=vae,
        config=StageOneConfig(
            beta=part.beta,
            drop_condition=part.drop_condition,
            time=part.time,
            sampler=part.sampler,
            guidance=Guidance(strength={"geometry": part.guidance_strength}, interval=part.guidance_interval),
            latent_scale=_latent_scale(config, vae, device),
        ),
    )


@torch.no_grad()
def _latent_scale(config: TrainingConfig, vae: StructureVae, device: torch.device) -> float:
    """Root mean square of the latents of the training shapes: the flow starts from unit noise."""
    stream = replace(
        config.data, batch_size=8, views=(1, 1), image_size=32, endless=False, workers=0, samples_per_motion=1
    )
    squares = [
        vae.encoder(batch.occupancy.to(device)).mean.square().mean()
        for batch in islice(ShardStream(stream), 16)
    ]
    return float(torch.stack(squares).mean().sqrt())


def _image_encoder(config: TrainingConfig) -> FeatureEncoder:
    chosen = config.encoders.image
    encoder: FeatureEncoder = (
        load_dino(chosen) if isinstance(chosen, DinoConfig) else load_efficientnet(chosen)
    )
    return _cached(encoder, config)


def _hand_encoder(config: TrainingConfig, folder: Path) -> FeatureEncoder:
    chosen = config.encoders.hand
    if not isinstance(chosen, OwnHandEncoder):
        return _cached(load_wilor(chosen), config)
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
    if state.config_sha256 != _sha256(name, config):
        raise ModelError(
            path,
            f"was trained with another configuration ({state.config_sha256[:12]})",
            expected=f"configuration {_sha256(name, config)[:12]}",
            action=f"Train the {name} of this configuration into another folder (--out).",
        )


def _sha256(name: str, config: TrainingConfig) -> str:
    """Of what decides the weights of a part: itself, the data, and the parts it stands on."""
    if name == "vae":
        return part_sha256(config.vae, config.data)
    if name == "hand_encoder":
        return part_sha256(config.hand_encoder, config.data)
    return part_sha256(config.stage_one, config.encoders, config.vae, config.hand_encoder, config.data)
