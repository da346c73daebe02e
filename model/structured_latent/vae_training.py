"""Training of the SLat VAE on the surfaces of the shards' objects."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from model.data.batch import Batch
from model.networks.sparse.grid import SparseGrid
from model.structured_latent.mesh_evaluation import (
    MeshEvaluationConfig,
    ScoredMesh,
    numbers_of_objects,
    scored_mesh,
)
from model.structured_latent.object_features.object_input import ObjectInputs, object_surface
from model.structured_latent.surface_images import comparison
from model.structured_latent.vae.decoder import SurfaceDecoder
from model.structured_latent.vae.encoder import SlatEncoder
from model.structured_latent.vae.latent import SlatVaeConfig, sample
from model.structured_latent.vae.surface_loss import SurfaceLossConfig, surface_loss
from model.training.task import Losses, Measurements

__all__ = ["SlatVae", "SlatVaeTask", "normal_rows"]

_FIRST_LOGVAR = -6.0


class SlatVae(nn.Module):
    """Encoder and surface decoder that are trained together.

    The encoder starts with latents of about unit size and little noise. With its published start, means and
    logvars near zero, the noise drowns what the decoder should learn from for hundreds of steps.
    """

    def __init__(self, config: SlatVaeConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = SlatEncoder(config)
        self.surface = SurfaceDecoder(config)
        head = self.encoder.out_layer
        with torch.no_grad():
            nn.init.xavier_uniform_(head.weight[: config.latent_channels])
            head.weight[config.latent_channels :] = 0.0
            head.bias[config.latent_channels :] = _FIRST_LOGVAR


@dataclass(frozen=True, kw_only=True, eq=False)
class SlatVaeTask:
    """Trains a SlatVae; a `Task` of model/training/task.py."""

    network: SlatVae
    loss_config: SurfaceLossConfig
    evaluation: MeshEvaluationConfig
    inputs: ObjectInputs

    @property
    def module(self) -> nn.Module:
        return self.network

    def loss(self, batch: Batch, generators: Sequence[torch.Generator]) -> Losses:
        """Surface, colour and KL terms (surface_loss.py), latents drawn with the generators' noise."""
        entry = self.inputs(batch)
        latent = self.network.encoder(entry.features)
        noise = normal_rows(entry.features.grid, self.network.config.latent_channels, generators)
        decoded = self.network.surface(sample(latent, noise))
        terms = surface_loss(decoded, latent, batch.true_surface, entry.corner_distances, self.loss_config)
        return Losses(
            total=terms.weighted(self.loss_config).mean(),
            parts={name: value.mean() for name, value in vars(terms).items()},
        )

    @torch.no_grad()
    def measure(self, batches: Iterable[Batch]) -> Measurements:
        """Scores of the meshes of mean latents, every object once; images: truth beside reconstruction."""
        meshes: dict[str, ScoredMesh] = {}
        rows = []
        for batch in batches:
            entry = self.inputs(batch)
            decoded = self.network.surface(self.network.encoder(entry.features).mean)
            for index, uid in enumerate(batch.true_surface.object_uids):
                if uid not in meshes:
                    truth = object_surface(batch.true_surface, index)
                    meshes[uid] = scored_mesh(decoded, index, truth, self.evaluation)
                    rows.append((truth, (meshes[uid].mesh,)))
        return Measurements(
            numbers={},
            of_objects=numbers_of_objects(meshes),
            images={"truth_and_reconstruction": comparison(rows)},
        )


def normal_rows(
    grid: SparseGrid, channels: int, generators: Sequence[torch.Generator]
) -> Float[Tensor, "voxel channel"]:
    """Standard normal numbers for every voxel, sample by sample; drawn on the CPU, so any device gets the same."""
    rows = [
        torch.randn(size, channels, generator=generator)
        for size, generator in zip(grid.sample_sizes, generators, strict=True)
    ]
    return torch.cat(rows).to(grid.device)
