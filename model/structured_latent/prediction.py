"""SlatPrediction: what stage 2 gives to whoever comes after it."""

from dataclasses import dataclass

from model.networks.sparse.tensor import SparseTensor
from model.surface.fields import SurfaceFields, surface_fields

__all__ = ["SlatPrediction", "decoded_fields"]


@dataclass(frozen=True, kw_only=True, eq=False)
class SlatPrediction:
    """Latents on the active voxels of a batch, and the surface decoder's channels on its finer grid."""

    latent: SparseTensor  # as the decoder takes them
    decoded: SparseTensor  # 101 channels (model.surface.fields)

    def fields(self, sample: int) -> SurfaceFields:
        """One object, ready for extraction. ModelError: it has no voxel."""
        return decoded_fields(self.decoded, sample)


def decoded_fields(decoded: SparseTensor, sample: int) -> SurfaceFields:
    """One object of a surface decoder's output, ready for extraction. ModelError: it has no voxel."""
    grid = decoded.grid
    start = sum(grid.sample_sizes[:sample])
    rows = slice(start, start + grid.sample_sizes[sample])
    return surface_fields(grid.coordinates[rows], decoded.features[rows], grid.resolution)
