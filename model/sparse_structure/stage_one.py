"""Stage 1 as one module and its training: amodal masks and shape denoised together (paper, 3.1-3.3)."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from model.data.batch import Batch
from model.encoders.aggregator import FeatureAggregator
from model.encoders.cached import uncached
from model.encoders.hand import HandEncoder, HandNet
from model.encoders.protocol import FeatureEncoder
from model.evaluation.overlap import intersection_over_union, voxel_chamfer
from model.flow import (
    Guidance,
    SamplerSettings,
    TimeDistribution,
    euler_sample,
    guided,
    interpolate,
    joint_cfm_loss,
    noise_like,
    times_from_uniform,
    velocity_target,
)
from model.networks.transformer import layer_norm
from model.sparse_structure.dual_branch import DualBranchConfig, DualBranchFlow, DualCondition
from model.sparse_structure.stage_one_images import prediction_rows
from model.sparse_structure.vae import StructureVae, occupancy_from_logits
from model.training.step_generators import batch_generator, normal_like, uniform
from model.training.task import Losses, Measurements

METRICS = (
    "voxel_iou",
    "mean_shape_iou",  # of the mean training shape, for every object
    "chamfer",  # share of the cube's side; of an empty shape, the cube's diagonal
    "empty",  # share of the predicted shapes without any voxel
    "mask_iou",  # of found and true amodal masks
    "visible_iou",  # of the true visible mask in place of the amodal one
    "found_visible_iou",  # of the visible mask that our hand network finds; NaN with another hand encoder
    "occluded_mask_iou",  # the same three where at least OCCLUDED of the object is hidden
    "occluded_visible_iou",
    "occluded_found_visible_iou",
)
OCCLUDED = 0.2

__all__ = ["METRICS", "Prediction", "StageOne", "StageOneConfig", "StageOneTask", "mask_targets"]


@dataclass(frozen=True, kw_only=True)
class StageOneConfig:
    """What is learned and how it is sampled."""

    beta: float  # weight of the 3D loss (Eq. 2)
    drop_condition: float  # share of samples without condition, for guidance (paper: 0.1)
    time: TimeDistribution
    sampler: SamplerSettings
    guidance: Guidance
    latent_scale: float  # latents are divided by it: unit variance; TRELLIS: 1


class StageOne(nn.Module):
    """The trained parts: feature aggregator and dual-branch flow.

    Published weights of the geometry branch expect layer-normed image features. Where the image encoder is as wide as
    its condition, the branch gets exactly these at the start, and mask tokens in addition as training brings them in;
    where it is not, the geometry sees the images through the mask tokens alone.
    """

    def __init__(self, aggregator: FeatureAggregator, config: DualBranchConfig) -> None:
        super().__init__()
        self.aggregator = aggregator
        self._image_context = aggregator.config.image_channels == config.geometry.condition_channels
        self.flow = DualBranchFlow(config, image_context=self._image_context)

    def condition(
        self,
        image_tokens: Float[Tensor, "batch view token image_channel"],
        hand_tokens: Float[Tensor, "batch view hand_token hand_channel"],
    ) -> DualCondition:
        """From the features of the views (section 3.1); a sampler computes it once for all its steps."""
        return DualCondition(
            features=self.aggregator(image_tokens, hand_tokens),
            images=layer_norm(image_tokens) if self._image_context else None,
        )


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """What stage 1 says about a batch of views."""

    occupancy: Bool[Tensor, "batch 64 64 64"]
    masks: Float[Tensor, "batch view m m"]  # amodal object mask: above 0 inside


@dataclass(frozen=True, kw_only=True, eq=False)
class StageOneTask:
    """Trains a StageOne on frozen encoders and VAE; a `Task` of model/training/task.py."""

    network: StageOne
    image_encoder: FeatureEncoder
    hand_encoder: FeatureEncoder
    vae: StructureVae  # frozen
    config: StageOneConfig
    mean_shape: Bool[Tensor, "64 64 64"]  # of the training objects: the baseline

    @property
    def module(self) -> nn.Module:
        return self.network

    @property
    def hand_net(self) -> HandNet | None:
        """Of the hand encoder, if it is ours: it finds visible objects, and hands."""
        inner = uncached(self.hand_encoder)
        return inner.network if isinstance(inner, HandEncoder) else None

    def condition(self, images: Float[Tensor, "batch view 3 size size"]) -> DualCondition:
        """What the flow knows of the views: frozen features, aggregated."""
        return self.network.condition(self.image_encoder(images), self.hand_encoder(images))

    def loss(self, batch: Batch, generators: Sequence[torch.Generator]) -> Losses:
        """Eq. 2: one t for both branches of a sample, condition dropped at random."""
        masks = mask_targets(batch.object_amodal, self.network.flow.config.masks.mask_resolution)
        latent = self.clean_latent(batch.occupancy)
        device = latent.device
        t = times_from_uniform(self.config.time, uniform(generators, device))
        dropped = uniform(generators, device) < self.config.drop_condition
        noise_latent, noise_masks = normal_like(latent, generators), normal_like(masks, generators)
        condition = self.condition(batch.images).dropped(dropped)
        latent_t, masks_t = interpolate(latent, noise_latent, t), interpolate(masks, noise_masks, t)
        velocity = self.network.flow(latent_t, masks_t, t, condition)
        losses = joint_cfm_loss(
            predicted_masks=velocity.masks,
            target_masks=velocity_target(masks, noise_masks),
            predicted_geometry=velocity.geometry,
            target_geometry=velocity_target(latent, noise_latent),
            beta=self.config.beta,
        )
        parts = {"masks": losses.masks.mean(), "geometry": losses.geometry.mean()}
        return Losses(total=losses.total, parts=parts)

    @torch.no_grad()
    def clean_latent(self, occupancy: Bool[Tensor, "batch 64 64 64"]) -> Float[Tensor, "batch channel i j k"]:
        """Mean latent of a shape, scaled."""
        return self.vae.encoder(occupancy).mean / self.config.latent_scale

    @torch.no_grad()
    def predict(
        self, images: Float[Tensor, "batch view 3 size size"], generator: torch.Generator
    ) -> Prediction:
        """Denoise masks and shape together; guidance as `config.guidance` says, per tensor name."""
        condition, flow = self.condition(images), self.network.flow
        features, resolution = condition.features, flow.config.masks.mask_resolution
        empty = {
            "geometry": features.new_zeros(len(images), *flow.config.geometry.latent_shape),
            "masks": features.new_zeros(*images.shape[:2], 1, resolution, resolution),
        }
        velocity = guided(
            _Velocity(flow, condition), _Velocity(flow, condition.unconditional()), self.config.guidance
        )
        noise = noise_like({k: v.cpu() for k, v in empty.items()}, generator)
        clean = euler_sample(
            velocity, {k: v.to(features.device) for k, v in noise.items()}, self.config.sampler
        )
        logits = self.vae.decoder(clean["geometry"] * self.config.latent_scale)
        return Prediction(occupancy=occupancy_from_logits(logits), masks=clean["masks"][:, :, 0])

    @torch.no_grad()
    def measure(self, batches: Iterable[Batch]) -> Measurements:
        """METRICS of every sample or view, with noise that belongs to the batch."""
        numbers: dict[str, list[float]] = {name: [] for name in METRICS}
        images: dict[str, np.ndarray] = {}
        for batch in batches:
            found = self.predict(batch.images, batch_generator(batch.ids))
            scores = _shape_scores(batch, found, self.mean_shape) | _mask_scores(batch, found, self.hand_net)
            for name, values in scores.items():
                numbers[name] += values.tolist()
            if not images:
                images = {"prediction": prediction_rows(batch, found.masks, found.occupancy)}
        return Measurements(numbers=numbers, images=images)


def _shape_scores(
    batch: Batch, found: Prediction, mean_shape: Bool[Tensor, "64 64 64"]
) -> dict[str, Float[Tensor, " n"]]:
    guess = mean_shape.to(batch.occupancy.device).expand_as(batch.occupancy)
    chamfer = [voxel_chamfer(a.cpu(), b.cpu()) for a, b in zip(found.occupancy, batch.occupancy)]
    return {
        "voxel_iou": intersection_over_union(found.occupancy, batch.occupancy),
        "mean_shape_iou": intersection_over_union(guess, batch.occupancy),
        "chamfer": torch.tensor(chamfer),
        "empty": (~found.occupancy.flatten(1).any(1)).float(),
    }


def _mask_scores(batch: Batch, found: Prediction, hand_net: HandNet | None) -> dict[str, Float[Tensor, " n"]]:
    """IoU of several masks with the amodal ones, of every view and of those where much of the object is hidden."""
    amodal, visible = batch.object_amodal.flatten(0, 1), batch.object_visible.flatten(0, 1)
    masks = {
        "mask_iou": _full_size(found.masks, amodal.shape[-1]).flatten(0, 1) > 0,
        "visible_iou": visible,
    }
    if hand_net is not None:
        masks["found_visible_iou"] = hand_net.visible_object(batch.images.flatten(0, 1))
    iou = {name: intersection_over_union(mask, amodal) for name, mask in masks.items()}
    occluded = iou["visible_iou"] < 1 - OCCLUDED  # a visible mask lies inside the amodal one
    return iou | {f"occluded_{name}": values[occluded] for name, values in iou.items()}


@dataclass(frozen=True, eq=False)
class _Velocity:
    """The flow as the sampler calls it."""

    flow: DualBranchFlow
    condition: DualCondition

    def __call__(self, state: dict[str, Tensor], t: Tensor) -> dict[str, Tensor]:
        velocity = self.flow(state["geometry"], state["masks"], t, self.condition)
        return {"geometry": velocity.geometry.float(), "masks": velocity.masks.float()}


def mask_targets(
    amodal: Bool[Tensor, "batch view size size"], resolution: int
) -> Float[Tensor, "batch view 1 m m"]:
    """Clean masks: +1 where the object covers more than half of a cell, else -1 (`binary_velocity` needs no others)."""
    covered = functional.adaptive_avg_pool2d(amodal.float().flatten(0, 1)[:, None], resolution)
    return torch.where(covered > 0.5, 1.0, -1.0).unflatten(0, amodal.shape[:2])


def _full_size(masks: Float[Tensor, "batch view m m"], size: int) -> Float[Tensor, "batch view size size"]:
    return functional.interpolate(masks, size=(size, size), mode="bilinear", align_corners=False)
