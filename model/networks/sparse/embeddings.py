"""Position embedding of voxels."""

from jaxtyping import Float
from torch import Tensor, nn

from model.networks.embeddings import sincos_position_embedding
from model.networks.sparse.grid import SparseGrid

__all__ = ["voxel_position_embedding"]


def voxel_position_embedding(grid: SparseGrid, channels: int) -> Float[Tensor, "voxel channel"]:
    """The rows of `sincos_position_embedding(resolution, 3, channels)` at the voxels; float32."""
    table = sincos_position_embedding(grid.resolution, 1, channels // 3 // 2 * 2)
    embedding = table.to(grid.device)[grid.coordinates].flatten(1)
    return nn.functional.pad(embedding, (0, channels - embedding.shape[1]))
