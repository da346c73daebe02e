"""Training of the sparse-structure VAE on the occupancies of the shards."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor, nn

from model.data.batch import Batch
from model.evaluation.overlap import intersection_over_union
from model.evaluation.voxel_image import voxel_image
from model.sparse_structure.vae import StructureVae, VaeConfig, occupancy_from_logits
from model.training.step_generators import normal_like, uniform
from model.training.task import Losses, Measurements

__all__ = ["VaeTask", "turned"]

_AXES = tuple(permutations((1, 2, 3)))


def turned(
    occupancy: Bool[Tensor, "batch i j k"], generators: Sequence[torch.Generator]
) -> Bool[Tensor, "batch i j k"]:
    """Each shape in one of the 48 orientations of the cube, mirrored ones included: more shapes from few objects."""
    choices = (48 * uniform(generators)).long().tolist()
    shapes = []
    for shape, choice in zip(occupancy, choices):
        axes = [axis - 1 for axis in _AXES[choice % 6]]
        flips = [axis for axis in range(3) if (choice // 6) >> axis & 1]
        shapes.append(shape.permute(axes).flip(flips))
    return torch.stack(shapes)


@dataclass(frozen=True, kw_only=True, eq=False)
class VaeTask:
    """Trains a StructureVae; a `Task` of model/training/task.py."""

    network: StructureVae
    config: VaeConfig
    turn: bool  # shapes in random orientations: for decoding what was never seen, slower to learn

    @property
    def module(self) -> nn.Module:
        return self.network

    def loss(self, batch: Batch, generators: Sequence[torch.Generator]) -> Losses:
        """Dice and KL (FORMATS 4.1)."""
        occupancy = turned(batch.occupancy, generators) if self.turn else batch.occupancy
        shape = self.config.latent_shape(occupancy.shape[-1])
        noise = normal_like(torch.zeros(len(occupancy), *shape, device=occupancy.device), generators)
        losses = self.network(occupancy, noise)
        return Losses(total=losses.total, parts={"dice": losses.dice.mean(), "kl": losses.kl.mean()})

    @torch.no_grad()
    def measure(self, batches: Iterable[Batch]) -> Measurements:
        """voxel_iou of every shape through encoder and decoder; images: truth beside reconstruction."""
        scores: list[float] = []
        images: dict[str, np.ndarray] = {}
        for batch in batches:
            decoded = occupancy_from_logits(self.network.decoder(self.network.encoder(batch.occupancy).mean))
            scores += intersection_over_union(decoded, batch.occupancy).tolist()
            if not images:
                rows = [
                    np.concatenate([voxel_image(truth), voxel_image(found)], axis=1)
                    for truth, found in zip(batch.occupancy.cpu(), decoded.cpu())
                ]
                images = {"truth_and_reconstruction": np.concatenate(rows[:4], axis=0)}
        return Measurements(numbers={"voxel_iou": scores}, images=images)
