"""The flow of stage 1: amodal masks and voxels, denoised together on a frozen VAE and frozen encoders.

RUN/stage_one/dataset_statistics.safetensors    what it needs of the training data when it is used
"""

from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Annotated, ClassVar

import torch
from jaxtyping import Bool
from torch import Tensor

from model.data.config import DataConfig
from model.encoders.hand import HandEncoder
from model.encoders.protocol import FeatureEncoder
from model.evaluation.overlap import mean_shape
from model.flow import LogitNormalTime, SamplerSettings, UniformTime
from model.networks.lora import LoraSettings, add_lora
from model.recipes.components.component import Component
from model.recipes.components.component_data import ComponentData
from model.recipes.components.component_identity import as_yaml, deciding_data, deciding_recipe, sha256_of
from model.recipes.components.dataset_statistics import DatasetStatistics, load_statistics, statistics_of_run
from model.recipes.components.flow_settings import (
    GuidanceConfig,
    guidance_of,
    require_adapter,
    require_condition,
)
from model.recipes.components.frozen_encoders import (
    EncodersConfig,
    OwnHandEncoder,
    aggregator_over,
    encoder_digests,
    given_hand_encoder,
    image_encoder,
    with_cache,
)
from model.recipes.components.hand_encoder_component import HandEncoderComponent
from model.recipes.components.recipe import ImageRecipe
from model.recipes.components.vae_component import VaeComponent
from model.sparse_structure.dual_branch import DualBranchConfig, DualBranchFlow
from model.sparse_structure.stage_one import StageOne, StageOneConfig, StageOneTask
from model.sparse_structure.vae import StructureVae
from model.weights.weight_file import StartConfig, load_start, weights_sha256
from shards.settings import Range

__all__ = ["StageOneComponent", "TrainedStageOne"]


@dataclass(frozen=True, kw_only=True)
class TrainedStageOne:
    """The dual-branch flow and its feature aggregator.

    `start`: weights to start from, null for random ones. `lora`: adapt the attention projections of the geometry
    branch and freeze the rest of it, null to train it whole; everything else always trains whole.
    """

    network: DualBranchConfig
    start: StartConfig | None
    lora: LoraSettings | None
    hand_width: Annotated[int, Range(1, 65_536)]  # of the aggregator (section 3.1)
    hidden: Annotated[int, Range(1, 65_536)]
    beta: Annotated[float, Range(0, 1e6)]
    drop_condition: Annotated[float, Range(0, 1)]
    time: UniformTime | LogitNormalTime
    sampler: SamplerSettings
    guidance: GuidanceConfig | None  # of the shape, null for none; masks go unguided
    recipe: ImageRecipe

    def __post_init__(self) -> None:
        if self.beta < 0:
            raise ValueError(f"beta is {self.beta}: expected beta >= 0")
        require_condition(self.drop_condition, self.guidance)
        require_adapter(self.lora, starts=self.start is not None)


@dataclass(frozen=True, kw_only=True)
class StageOneComponent(Component):
    """The flow of a configuration, and what it stands on."""

    name: ClassVar[str] = "stage_one"
    adapted_branch: ClassVar[str] = "geometry"  # the submodule of the flow that adapters are in
    file_prefix: ClassVar[str] = ""  # of the names of checkpoints, in weight files
    section: TrainedStageOne
    encoders: EncodersConfig
    vae: VaeComponent
    hand_encoder: HandEncoderComponent | None  # None: `encoders` has one that is not trained here
    data: DataConfig

    @property
    def recipe(self) -> ImageRecipe:
        return self.section.recipe

    @property
    def stands_on(self) -> tuple[Component, ...]:
        return (self.vae,) if self.hand_encoder is None else (self.vae, self.hand_encoder)

    @property
    def start_weights(self) -> Path | None:
        """The file that it starts from."""
        return None if self.section.start is None else self.section.start.weights

    def start_text(self, weights: Path) -> str:
        """`start` of a configuration that begins from `weights` instead of the file that this one names."""
        assert self.section.start is not None
        return f"{{weights: {weights}, latent_scale: {self.section.start.latent_scale}}}"

    def sha256(self) -> str:
        section = replace(self.section, recipe=deciding_recipe(self.section.recipe))
        return sha256_of(
            as_yaml(section),
            as_yaml(self.encoders),
            as_yaml(deciding_data(self.data)),
            *encoder_digests(self.encoders),
            *(earlier.sha256() for earlier in self.stands_on),
            *(() if self.start_weights is None else (weights_sha256(self.start_weights),)),
        )

    def flow(self) -> DualBranchFlow:
        """With the weights that torch's global generator gives."""
        return DualBranchFlow(self.section.network)

    def task(self, run: Path, data: ComponentData, device: torch.device) -> StageOneTask:
        vae = self.vae.load(run).to(device)
        statistics = statistics_of_run(run / self.name, lambda: self._measured(vae, data, device))
        return self._task(run, vae, statistics, device)

    def load(self, run: Path, device: torch.device) -> StageOneTask:
        """With the averaged weights of its newest checkpoint, for inference. ModelError."""
        statistics = load_statistics(run / self.name)
        task = self._task(run, self.vae.load(run).to(device), statistics, device)
        self.load_trained(run, task.module)
        task.module.to(device).eval()
        return task

    def _task(
        self, run: Path, vae: StructureVae, statistics: DatasetStatistics, device: torch.device
    ) -> StageOneTask:
        """Untrained, or with the weights that it starts from, and adapters on them."""
        section = self.section
        image, hand = image_encoder(self.encoders), self._hand_encoder(run)
        image.to(device, torch.float32)
        hand.to(device, torch.float32)
        aggregator = aggregator_over(
            image,
            hand,
            hand_width=section.hand_width,
            hidden=section.hidden,
            channels=section.network.masks.feature_channels,
        )
        network = StageOne(aggregator, section.network)
        if section.start is not None:
            load_start(section.start.weights, network)
        if section.lora is not None:
            add_lora(network.flow.get_submodule(self.adapted_branch), section.lora)
        return StageOneTask(
            network=network,
            image_encoder=image,
            hand_encoder=hand,
            vae=vae,
            config=StageOneConfig(
                beta=section.beta,
                drop_condition=section.drop_condition,
                time=section.time,
                sampler=section.sampler,
                guidance=guidance_of(section.guidance, "geometry"),
                latent_scale=statistics.latent_scale,
            ),
            mean_shape=statistics.mean_shape,
        )

    def _hand_encoder(self, run: Path) -> FeatureEncoder:
        chosen = self.encoders.hand
        if self.hand_encoder is None or not isinstance(chosen, OwnHandEncoder):
            return given_hand_encoder(self.encoders)
        network = self.hand_encoder.load(run)
        return with_cache(HandEncoder(network=network, grid=chosen.own_grid), self.encoders)

    def _measured(self, vae: StructureVae, data: ComponentData, device: torch.device) -> DatasetStatistics:
        """On the first 128 motions of the training data."""
        batches = islice(data.each_motion_once(8), 16)
        shapes, start = torch.cat([batch.occupancy for batch in batches]), self.section.start
        return DatasetStatistics(
            latent_scale=start.latent_scale if start else _latent_scale(vae, shapes, device),
            mean_shape=mean_shape(shapes),
        )


@torch.no_grad()
def _latent_scale(vae: StructureVae, shapes: Bool[Tensor, "shape 64 64 64"], device: torch.device) -> float:
    """Root mean square of the latents of the training shapes: the flow starts from unit noise."""
    squares = [vae.encoder(part.to(device)).mean.square().mean((1, 2, 3, 4)) for part in shapes.split(8)]
    return float(torch.cat(squares).mean().sqrt())
