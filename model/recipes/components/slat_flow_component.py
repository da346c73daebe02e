"""The flow of stage 2: structured latents, denoised given views of the occluded object, on a frozen VAE."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar

import torch

from model.data.config import DataConfig
from model.encoders.protocol import FeatureEncoder
from model.flow import LogitNormalTime, SamplerSettings, UniformTime
from model.networks.lora import LoraSettings, add_lora
from model.networks.sparse.tensor import SparseTensor
from model.recipes.components.component import Component
from model.recipes.components.component_data import ComponentData
from model.recipes.components.component_identity import as_yaml, deciding_data, deciding_recipe, sha256_of
from model.recipes.components.flow_settings import (
    GuidanceConfig,
    guidance_of,
    require_adapter,
    require_condition,
)
from model.recipes.components.frozen_encoders import (
    EncodersConfig,
    aggregator_over,
    encoder_digests,
    given_hand_encoder,
    image_encoder,
)
from model.recipes.components.recipe import ImageRecipe
from model.recipes.components.slat_vae_component import SlatVaeComponent
from model.structured_latent.flow import SlatFlow, SlatFlowConfig
from model.structured_latent.flow_training import LATENT, SlatFlowTask, SlatFlowTraining
from model.structured_latent.mesh_evaluation import MeshEvaluationConfig
from model.structured_latent.object_features.object_input import ObjectInputs
from model.structured_latent.vae.latent import LatentNormalisation
from model.structured_latent.vae_training import SlatVae
from model.structured_latent.view_conditioned import ViewConditionedSlatFlow
from model.weights.slat import STAGE_TWO, load_stage_two_start
from model.weights.weight_file import weights_sha256
from shards.settings import Range

__all__ = ["SlatFlowComponent", "TrainedSlatFlow"]


@dataclass(frozen=True, kw_only=True)
class TrainedSlatFlow:
    """The structured-latent flow and what conditions it.

    `start`: a weight file to start from, null for random ones. `lora`: adapt the attention projections of the flow and
    freeze the rest of it, null to train it whole; what is new in stage 2 always trains whole.
    """

    network: SlatFlowConfig
    start: Path | None
    lora: LoraSettings | None
    hand_width: Annotated[int, Range(1, 65_536)]  # of the aggregator (section 3.1)
    hidden: Annotated[int, Range(1, 65_536)]
    drop_condition: Annotated[float, Range(0, 1)]
    time: UniformTime | LogitNormalTime
    sampler: SamplerSettings
    guidance: GuidanceConfig | None  # null for none
    recipe: ImageRecipe

    def __post_init__(self) -> None:
        require_condition(self.drop_condition, self.guidance)
        require_adapter(self.lora, starts=self.start is not None)


@dataclass(frozen=True, kw_only=True)
class SlatFlowComponent(Component):
    """The flow of a configuration, and what it stands on."""

    name: ClassVar[str] = "slat_flow"
    reads_surfaces: ClassVar[bool] = True
    adapted_branch: ClassVar[str] = ""  # the submodule of the flow that adapters are in: all of it
    file_prefix: ClassVar[str] = STAGE_TWO  # of the names of checkpoints, in weight files
    section: TrainedSlatFlow
    encoders: EncodersConfig
    vae: SlatVaeComponent
    meshes: MeshEvaluationConfig
    data: DataConfig

    @property
    def recipe(self) -> ImageRecipe:
        return self.section.recipe

    @property
    def stands_on(self) -> tuple[Component, ...]:
        return (self.vae,)

    @property
    def start_weights(self) -> Path | None:
        """The file that it starts from."""
        return self.section.start

    def start_text(self, weights: Path) -> str:
        """`start` of a configuration that begins from `weights` instead of the file that this one names."""
        return str(weights)

    def sha256(self) -> str:
        section = replace(self.section, recipe=deciding_recipe(self.section.recipe))
        return sha256_of(
            as_yaml(section),
            as_yaml(self.encoders),
            as_yaml(deciding_data(self.data)),
            *encoder_digests(self.encoders),
            self.vae.sha256(),
            *(() if self.start_weights is None else (weights_sha256(self.start_weights),)),
        )

    def flow(self) -> SlatFlow:
        """With the weights that torch's global generator gives."""
        return SlatFlow(self.section.network)

    def task(self, run: Path, data: ComponentData, device: torch.device) -> SlatFlowTask:
        vae = self.vae.load(run).to(device)
        image = image_encoder(self.encoders).to(device, torch.float32)
        inputs = self.vae.inputs(data, image, device)
        if self.section.start is None:
            normalisation = LatentNormalisation.measured(_training_latents(vae, inputs, data, device))
        else:  # which brings its own
            normalisation = LatentNormalisation.identity(self.section.network.latent_channels)
        return self._task(vae, inputs, image, normalisation, device)

    def load(self, run: Path, device: torch.device) -> SlatFlowTask:
        """With the averaged weights of its newest checkpoint, for inference. ModelError."""
        vae = self.vae.load(run).to(device)
        # The checkpoint brings the normalisation that the flow was trained with.
        identity = LatentNormalisation.identity(self.section.network.latent_channels)
        image = image_encoder(self.encoders).to(device, torch.float32)
        # Inputs are of use for true objects only, which nobody knows at inference.
        task = self._task(vae, ObjectInputs(of_views=None), image, identity, device)
        self.load_trained(run, task.module)
        task.module.to(device).eval()
        return task

    def _task(
        self,
        vae: SlatVae,
        inputs: ObjectInputs,
        image: FeatureEncoder,
        normalisation: LatentNormalisation,
        device: torch.device,
    ) -> SlatFlowTask:
        """Untrained, or with the weights that it starts from, and adapters on them."""
        section = self.section
        hand = given_hand_encoder(self.encoders).to(device, torch.float32)
        aggregator = aggregator_over(
            image,
            hand,
            hand_width=section.hand_width,
            hidden=section.hidden,
            channels=section.network.condition_channels,
        )
        network = ViewConditionedSlatFlow(aggregator, self.flow(), normalisation)
        if section.start is not None:
            load_stage_two_start(section.start, network)
        if section.lora is not None:
            add_lora(network.flow.get_submodule(self.adapted_branch), section.lora)
        return SlatFlowTask(
            network=network,
            image_encoder=image,
            hand_encoder=hand,
            vae=vae,
            config=SlatFlowTraining(
                drop_condition=section.drop_condition,
                time=section.time,
                sampler=section.sampler,
                guidance=guidance_of(section.guidance, LATENT),
            ),
            evaluation=self.meshes,
            inputs=inputs,
        )


@torch.no_grad()
def _training_latents(
    vae: SlatVae, inputs: ObjectInputs, data: ComponentData, device: torch.device
) -> Iterator[SparseTensor]:
    """Mean latents of the training objects, each once."""
    seen = set[str]()
    for batch in data.each_motion_once(1):
        on_device = batch.to(device, torch.float32)
        if (uid := on_device.true_surface.object_uids[0]) not in seen:
            seen.add(uid)
            yield vae.encoder(inputs(on_device).features).mean
