"""Training of the SLat flow: latents of the true voxels, denoised given views of the occluded object (section 3.3)."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from model.data.batch import Batch
from model.encoders.protocol import FeatureEncoder
from model.flow import (
    Guidance,
    SamplerSettings,
    TimeDistribution,
    euler_sample,
    guided,
    interpolate,
    times_from_uniform,
    velocity_target,
)
from model.networks.sparse.grid import SparseGrid
from model.networks.sparse.tensor import SparseTensor
from model.structured_latent.mesh_evaluation import MeshEvaluationConfig, ScoredMesh, mean_scores, scored_mesh
from model.structured_latent.object_features.object_input import ObjectInputs, object_surface
from model.structured_latent.prediction import SlatPrediction
from model.structured_latent.surface_images import comparison
from model.structured_latent.vae_training import SlatVae, normal_rows
from model.structured_latent.view_conditioned import ViewCondition, ViewConditionedSlatFlow
from model.training.step_generators import uniform
from model.training.task import Evaluation, Losses

__all__ = ["LATENT", "SlatFlowTask", "SlatFlowTraining"]

LATENT = "latent"
"""Name of the latents in sampler states and in `Guidance.strength`."""


@dataclass(frozen=True, kw_only=True)
class SlatFlowTraining:
    """What is learned and how it is sampled."""

    drop_condition: float  # share of samples without condition, for guidance
    time: TimeDistribution
    sampler: SamplerSettings
    guidance: Guidance


@dataclass(frozen=True, kw_only=True, eq=False)
class SlatFlowTask:
    """Trains a ViewConditionedSlatFlow on frozen encoders and VAE; a `Task` of model/training/task.py."""

    network: ViewConditionedSlatFlow
    image_encoder: FeatureEncoder
    hand_encoder: FeatureEncoder
    vae: SlatVae  # frozen
    config: SlatFlowTraining
    evaluation: MeshEvaluationConfig
    inputs: ObjectInputs  # of the true objects, for training and metrics

    @property
    def module(self) -> nn.Module:
        return self.network

    def condition(self, images: Float[Tensor, "batch view 3 size size"]) -> ViewCondition:
        """What the flow attends to: frozen features of the views, projected and weighted."""
        return self.network.condition(self.image_encoder(images), self.hand_encoder(images))

    def loss(self, batch: Batch, generators: Sequence[torch.Generator]) -> Losses:
        """Mean squared error of the velocity: mean over a sample's voxels, then over samples.

        TRELLIS takes one mean over the voxels of all samples, so that large objects count more. Here each object counts
        alike, and the loss of a global batch does not depend on how ranks share it. `config.time`: TRELLIS draws t
        logit-normal(1, 1), the paper uniformly.
        """
        clean = self.clean_latent(batch)
        grid, device = clean.grid, clean.features.device
        t = times_from_uniform(self.config.time, uniform(generators, device))
        dropped = uniform(generators, device) < self.config.drop_condition
        noise = normal_rows(grid, clean.features.shape[1], generators)
        x_t = clean.with_features(interpolate(clean.features, noise, t[grid.batch_index]))
        velocity = self.network(x_t, t, self.condition(batch.images).dropped(dropped))
        wrong = (velocity.features.float() - velocity_target(clean.features, noise)).square().mean(1)
        total = wrong.new_zeros(grid.batch_size).index_add(0, grid.batch_index, wrong)
        counts = torch.tensor(grid.sample_sizes, device=device).clamp(min=1)
        return Losses(total=(total / counts).mean(), parts={})

    @torch.no_grad()
    def clean_latent(self, batch: Batch) -> SparseTensor:
        """Normalised mean latents of the true objects."""
        mean = self.vae.encoder(self.inputs(batch).features).mean
        return self.network.normalisation.normalised(mean)

    @torch.no_grad()
    def predict(
        self,
        images: Float[Tensor, "batch view 3 size size"],
        occupancy: Bool[Tensor, "batch i j k"],
        generator: torch.Generator,
    ) -> SlatPrediction:
        """Latents on the given voxels from the views, and their surface; float32 whatever the images are."""
        grid = SparseGrid.from_occupancy(occupancy)
        condition = self.condition(images)
        velocity = guided(
            _Velocity(self.network, grid, condition),
            _Velocity(self.network, grid, condition.unconditional()),
            self.config.guidance,
        )
        shape = (grid.voxels, self.network.flow.config.latent_channels)
        noise = torch.randn(shape, generator=generator).to(grid.device)
        clean = euler_sample(velocity, {LATENT: noise}, self.config.sampler)[LATENT]
        return self.decoded(SparseTensor(grid=grid, features=clean))

    @torch.no_grad()
    def decoded(self, normalised: SparseTensor) -> SlatPrediction:
        """The surface of normalised latents."""
        latent = self.network.normalisation.restored(normalised)
        return SlatPrediction(latent=latent, decoded=self.vae.surface(latent))

    @torch.no_grad()
    def evaluate(self, batches: Iterable[Batch]) -> Evaluation:
        """Scores of meshes from sampled latents on the true voxels, fixed noise; every sample of the batches.

        Beside them, every object once: what they have to beat, the mean latent at every voxel (mean_latent_*), and
        what they cannot beat, the latents of the true object (true_latent_*). `latent_error` is the mean squared
        error of sampled normalised latents: about 1 for the mean latent, 2 for samples that ignore the images.
        """
        found: list[ScoredMesh] = []
        baseline: dict[str, ScoredMesh] = {}
        ceiling: dict[str, ScoredMesh] = {}
        errors: list[float] = []
        rows = []
        generator = torch.Generator().manual_seed(0)
        for batch in batches:
            prediction = self.predict(batch.images, batch.occupancy, generator)
            clean = self.clean_latent(batch)
            wrong = self.network.normalisation.normalised(prediction.latent).features - clean.features
            errors += [float(part.square().mean()) for part in wrong.split(clean.grid.sample_sizes)]
            uids = batch.true_surface.object_uids
            truths = [object_surface(batch.true_surface, index) for index in range(len(uids))]
            if not ceiling.keys() >= set(uids):
                mean = self.decoded(clean.with_features(torch.zeros_like(clean.features)))
                true = self.decoded(clean)
                for index, (uid, truth) in enumerate(zip(uids, truths)):
                    if uid not in ceiling:
                        baseline[uid] = scored_mesh(mean.decoded, index, truth, self.evaluation)
                        ceiling[uid] = scored_mesh(true.decoded, index, truth, self.evaluation)
            for index, (uid, truth) in enumerate(zip(uids, truths)):
                found.append(scored_mesh(prediction.decoded, index, truth, self.evaluation))
                rows.append((truth, (found[-1].mesh, baseline[uid].mesh, ceiling[uid].mesh)))
        metrics = mean_scores(found) | {"latent_error": float(np.mean(errors)) if errors else float("nan")}
        metrics |= _named("mean_latent", mean_scores(list(baseline.values())))
        metrics |= _named("true_latent", mean_scores(list(ceiling.values())))
        return Evaluation(metrics=metrics, images={"truth_sampled_mean_latent_true_latent": comparison(rows)})


@dataclass(frozen=True, eq=False)
class _Velocity:
    """The flow as the sampler calls it: all voxels of the batch are rows of one tensor, at one t."""

    network: ViewConditionedSlatFlow
    grid: SparseGrid
    condition: ViewCondition

    def __call__(self, state: dict[str, Tensor], t: Tensor) -> dict[str, Tensor]:
        x_t = SparseTensor(grid=self.grid, features=state[LATENT])
        of_sample = t[:1].expand(self.grid.batch_size)
        return {LATENT: self.network(x_t, of_sample, self.condition).features.float()}


def _named(prefix: str, metrics: Mapping[str, float]) -> dict[str, float]:
    return {f"{prefix}_{name}": value for name, value in metrics.items()}
