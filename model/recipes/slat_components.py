"""The parts of stage 2, trained one after the other: structured-latent VAE, structured-latent flow.

RUN/slat_vae, RUN/slat_flow    checkpoints, TensorBoard logs, metrics.json
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import torch
from accelerate import Accelerator

from model.data.batch import Batch
from model.data.stream import ShardStream
from model.encoders.protocol import FeatureEncoder
from model.errors import ModelError
from model.flow import Guidance
from model.networks.lora import add_lora
from model.networks.sparse.tensor import SparseTensor
from model.recipes.component_identity import deciding_data, deciding_recipe, encoder_digests, sha256_of
from model.recipes.component_run import PartData, load_part, one_pass, part_data, require_same_data, run_part
from model.recipes.config import Recipe, as_yaml
from model.recipes.frozen_encoders import aggregator_over, given_hand_encoder, image_encoder
from model.recipes.slat_config import ImportedSlatVae, SlatTrainingConfig, SlatVaePart
from model.structured_latent.flow import SlatFlow
from model.structured_latent.flow_training import LATENT, SlatFlowTask, SlatFlowTraining
from model.structured_latent.object_features.object_input import ObjectInputs
from model.structured_latent.object_features.object_mesh import ObjectMeshes
from model.structured_latent.object_features.surface_features import SurfaceFeatures
from model.structured_latent.object_features.view_encoder import view_encoder
from model.structured_latent.object_features.view_features import ViewFeatures
from model.structured_latent.vae.latent import LatentNormalisation
from model.structured_latent.vae_training import SlatVae, SlatVaeTask
from model.structured_latent.view_conditioned import ViewConditionedSlatFlow
from model.training.task import Task
from model.training.trainer import TrainingEvent
from model.weights.slat import load_slat_vae, load_stage_two_start
from model.weights.weight_file import weights_sha256

__all__ = ["SLAT_PARTS", "load_slat_flow", "slat_part_sha256", "train_slat_part", "trained_slat_parts"]

SLAT_VAE, SLAT_FLOW = "slat_vae", "slat_flow"
SLAT_PARTS = (SLAT_VAE, SLAT_FLOW)


def trained_slat_parts(config: SlatTrainingConfig) -> tuple[str, ...]:
    """The parts that this configuration trains, in order; the other has weights already."""
    return SLAT_PARTS if isinstance(config.slat_vae, SlatVaePart) else (SLAT_FLOW,)


def train_slat_part(
    name: str,
    config: SlatTrainingConfig,
    folder: Path,
    *,
    accelerator: Accelerator,
    report: Callable[[TrainingEvent], None],
) -> dict[str, float]:
    """Train one part (see SLAT_PARTS) and give its metrics on held-out views. The VAE comes first.

    Continues where it was stopped. ModelError when the VAE is missing, of another configuration or of other data.
    """
    recipe = _recipe(name, config)
    data = part_data(replace(config.data, surface=True), config.validation, recipe, accelerator)
    torch.manual_seed(recipe.trainer.seed)  # of the initial weights
    task: Task
    if name == SLAT_VAE:
        task = _vae_task(config, data, accelerator.device)
    else:
        task = _flow_task(config, folder, data, accelerator.device)
    return run_part(
        task,
        data,
        recipe,
        folder / name,
        config_yaml=as_yaml(config),
        config_sha256=slat_part_sha256(name, config),
        accelerator=accelerator,
        report=report,
    )


def load_slat_flow(config: SlatTrainingConfig, folder: Path, device: torch.device) -> SlatFlowTask:
    """Stage 2 with the averaged weights of its newest checkpoint, for inference: `.predict`."""
    vae = _frozen_vae(config, folder, device)
    # The checkpoint brings the normalisation that the flow was trained with.
    identity = LatentNormalisation.identity(config.slat_flow.network.latent_channels)
    image = image_encoder(config.encoders).to(device, torch.float32)
    # Of use for true objects only, which nobody knows at inference.
    task = _assembled(config, vae, ObjectInputs(of_views=None), image, identity, device)
    load_part(folder / SLAT_FLOW, task.module, config_sha256=slat_part_sha256(SLAT_FLOW, config))
    task.module.to(device).eval()
    return task


def slat_part_sha256(name: str, config: SlatTrainingConfig) -> str:
    """Changes with anything that decides what training a part gives. ModelError when a weight file is missing."""
    vae = config.slat_vae
    if not isinstance(vae.features, SurfaceFeatures):
        vae = replace(vae, features=replace(vae.features, cache=None))
    if isinstance(vae, SlatVaePart):
        vae = replace(vae, recipe=deciding_recipe(vae.recipe))
    texts = [as_yaml(vae), as_yaml(deciding_data(config.data))]
    if isinstance(vae, ImportedSlatVae):
        texts.append(weights_sha256(vae.weights))
    if not isinstance(vae.features, SurfaceFeatures):
        texts.append(as_yaml(config.encoders.image))
    if name == SLAT_FLOW:
        flow = replace(config.slat_flow, recipe=deciding_recipe(config.slat_flow.recipe))
        texts += [as_yaml(flow), as_yaml(config.encoders), *encoder_digests(config.encoders)]
        texts += [weights_sha256(flow.start)] if flow.start is not None else []
    return sha256_of(*texts)


def _recipe(name: str, config: SlatTrainingConfig) -> Recipe:
    part = config.slat_vae if name == SLAT_VAE else config.slat_flow
    if isinstance(part, ImportedSlatVae):
        raise ModelError(
            f"{config.name}: {name}",
            "has weights already, there is nothing to train",
            expected=SLAT_FLOW,
            action=f"Train that, or give a {SLAT_VAE} with a recipe.",
        )
    return part.recipe


def _vae_task(config: SlatTrainingConfig, data: PartData, device: torch.device) -> SlatVaeTask:
    part = config.slat_vae
    assert isinstance(part, SlatVaePart)  # else there is no recipe
    return SlatVaeTask(
        network=SlatVae(part.network),
        loss_config=part.loss,
        evaluation=config.meshes,
        inputs=_object_inputs(config, data, None, device),
    )


def _flow_task(
    config: SlatTrainingConfig, folder: Path, data: PartData, device: torch.device
) -> SlatFlowTask:
    if isinstance(config.slat_vae, SlatVaePart):
        require_same_data(folder / SLAT_VAE, data)
    vae = _frozen_vae(config, folder, device)
    image = image_encoder(config.encoders).to(device, torch.float32)
    inputs = _object_inputs(config, data, image, device)
    if config.slat_flow.start is None:
        normalisation = LatentNormalisation.measured(_training_latents(config, vae, inputs, device))
    else:  # which brings its own
        normalisation = LatentNormalisation.identity(config.slat_flow.network.latent_channels)
    return _assembled(config, vae, inputs, image, normalisation, device)


def _object_inputs(
    config: SlatTrainingConfig, data: PartData, image: FeatureEncoder | None, device: torch.device
) -> ObjectInputs:
    """Of the kind that the VAE reads; `image`: the image encoder where it is there already."""
    part = config.slat_vae
    if isinstance(part.features, SurfaceFeatures):
        return ObjectInputs(of_views=None)
    if image is None:
        image = image_encoder(config.encoders).to(device, torch.float32)
    encoder = view_encoder(image)
    if encoder.encoder.channels != part.network.feature_channels:
        raise ModelError(
            f"{config.name}: slat_vae.network.feature_channels",
            f"is {part.network.feature_channels}, encoders.image gives {encoder.encoder.channels} channels",
            expected="the same",
            action=f"Set it to {encoder.encoder.channels}, or choose the other encoder.",
        )
    return ObjectInputs(
        of_views=ViewFeatures(
            meshes=ObjectMeshes(shards=data.training.index.shards),
            encoder=encoder,
            config=part.features,
            device=device,
        )
    )


def _assembled(
    config: SlatTrainingConfig,
    vae: SlatVae,
    inputs: ObjectInputs,
    image: FeatureEncoder,
    normalisation: LatentNormalisation,
    device: torch.device,
) -> SlatFlowTask:
    """Untrained, or with the weights that it starts from, and adapters on them."""
    part = config.slat_flow
    hand = given_hand_encoder(config.encoders).to(device, torch.float32)
    aggregator = aggregator_over(
        image,
        hand,
        hand_width=part.hand_width,
        hidden=part.hidden,
        channels=part.network.condition_channels,
    )
    network = ViewConditionedSlatFlow(aggregator, SlatFlow(part.network), normalisation)
    if part.start is not None:
        load_stage_two_start(part.start, network)
    if part.lora is not None:
        add_lora(network.flow, part.lora)
    return SlatFlowTask(
        network=network,
        image_encoder=image,
        hand_encoder=hand,
        vae=vae,
        config=SlatFlowTraining(
            drop_condition=part.drop_condition,
            time=part.time,
            sampler=part.sampler,
            guidance=Guidance(strength={LATENT: part.guidance_strength}, interval=part.guidance_interval),
        ),
        evaluation=config.meshes,
        inputs=inputs,
    )


def _frozen_vae(config: SlatTrainingConfig, folder: Path, device: torch.device) -> SlatVae:
    """Imported or trained."""
    vae = SlatVae(config.slat_vae.network)
    if isinstance(config.slat_vae, ImportedSlatVae):
        load_slat_vae(config.slat_vae.weights, vae.encoder, vae.surface)
    else:
        load_part(folder / SLAT_VAE, vae, config_sha256=slat_part_sha256(SLAT_VAE, config))
    return vae.to(device).eval().requires_grad_(False)


@torch.no_grad()
def _training_latents(
    config: SlatTrainingConfig, vae: SlatVae, inputs: ObjectInputs, device: torch.device
) -> Iterator[SparseTensor]:
    """Mean latents of the training objects, each once."""
    stream = replace(one_pass(config.data, 1), surface=True)
    seen = set[str]()
    for batch in ShardStream(stream):
        on_device: Batch = batch.to(device, torch.float32)
        if (uid := on_device.true_surface.object_uids[0]) not in seen:
            seen.add(uid)
            yield vae.encoder(inputs(on_device).features).mean
