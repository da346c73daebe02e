"""Batches of voxel features for the SLat encoder, each object's computed once."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from model.data.batch import Batch, SurfaceBatch, SurfaceTarget
from model.networks.sparse.grid import SparseGrid
from model.networks.sparse.tensor import SparseTensor
from model.structured_latent.object_features.surface_features import VoxelFeatures, object_features
from model.structured_latent.object_features.view_features import ViewFeatures
from shards.storage.bounded_cache import BoundedCache

__all__ = ["ObjectInput", "ObjectInputs", "object_surface"]

_MAX_OBJECTS = 256  # mirrored ones count apart; an object takes about 1 MB


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectInput:
    """What encoder and loss read of a batch."""

    features: SparseTensor  # on the active voxels
    corner_distances: Float[Tensor, "voxel 8"]  # voxels, negative inside


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectInputs:
    """Makes them, and keeps the last objects, recognised by their content. Not shared between processes.

    `of_views` makes the features; None: those of the objects' own surfaces.
    """

    of_views: ViewFeatures | None
    _kept: BoundedCache[VoxelFeatures] = field(default_factory=lambda: BoundedCache(_MAX_OBJECTS), init=False)

    def __call__(self, batch: Batch) -> ObjectInput:
        """On the batch's device. ModelError where the batch comes without surfaces."""
        truth = batch.true_surface
        found = [
            self._features(occupancy.cpu().numpy(), object_surface(truth, sample))
            for sample, occupancy in enumerate(batch.occupancy)
        ]
        device = batch.occupancy.device
        rows = torch.cat(self._rows(batch, found))
        distances = torch.from_numpy(np.concatenate([features.distances for features in found]))
        return ObjectInput(
            features=SparseTensor(
                grid=SparseGrid.from_occupancy(batch.occupancy), features=rows.to(device).float()
            ),
            corner_distances=distances.to(device),
        )

    def _rows(self, batch: Batch, found: Sequence[VoxelFeatures]) -> list[Float[Tensor, "voxel channel"]]:
        """What the encoder reads, sample by sample."""
        if self.of_views is None:
            return [torch.from_numpy(features.rows()) for features in found]
        truth = batch.true_surface
        return [
            self.of_views.rows(uid, occupancy.cpu().numpy(), is_mirrored=is_mirrored)
            for uid, occupancy, is_mirrored in zip(truth.object_uids, batch.occupancy, truth.are_mirrored)
        ]

    def _features(self, occupancy: Bool[np.ndarray, "i j k"], surface: SurfaceTarget) -> VoxelFeatures:
        digest = hashlib.blake2b(np.packbits(occupancy).tobytes(), digest_size=16)
        for samples in (
            surface.points,
            surface.normals,
            surface.colors,
            surface.sdf_points,
            surface.sdf_values,
        ):
            digest.update(np.ascontiguousarray(samples).data)
        return self._kept.get(
            digest.digest(),
            lambda: object_features(surface, np.argwhere(occupancy), occupancy.shape[0]),
            lambda _: 1,
        )


def object_surface(truth: SurfaceBatch, sample: int) -> SurfaceTarget:
    """The surface of one sample of a batch."""
    part = truth.part(sample, sample + 1)
    return SurfaceTarget(
        points=part.points.cpu().numpy(),
        normals=part.normals.cpu().numpy(),
        colors=part.colors.cpu().numpy(),
        sdf_points=part.sdf_points.cpu().numpy(),
        sdf_values=part.sdf_values.cpu().numpy(),
        object_scale_m=part.object_scales_m[0],
        is_mirrored=part.are_mirrored[0],
    )
