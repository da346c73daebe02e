"""The trunk that encoder and decoders share: an embedding and transformer blocks with shifted windows.

Functions instead of a module: in the published files these parameters have no prefix of their own.
"""

from collections.abc import Iterable

from torch import nn

from model.networks.sparse.embeddings import voxel_position_embedding
from model.networks.sparse.tensor import SparseTensor
from model.networks.sparse.transformer import SparseTransformerBlock, shifted_windows
from model.structured_latent.vae.latent import SlatVaeConfig

__all__ = ["embedded", "run_trunk", "trunk_blocks"]


def trunk_blocks(config: SlatVaeConfig) -> nn.ModuleList:
    """The blocks of a trunk; every other one has its windows shifted by half."""
    return nn.ModuleList(
        SparseTransformerBlock(
            channels=config.channels, heads=config.heads, mlp_ratio=config.mlp_ratio, window=window
        )
        for window in shifted_windows(config.window, config.blocks)
    )


def run_trunk(x: SparseTensor, input_layer: nn.Linear, blocks: Iterable[nn.Module]) -> SparseTensor:
    """Embedding with positions, then the blocks; no norm at the end."""
    h = embedded(x.map(input_layer), input_layer)
    for block in blocks:
        h = block(h)
    return h


def embedded(h: SparseTensor, of: nn.Linear) -> SparseTensor:
    """h + the embedding of its voxels' positions, in the type of the parameters: float32 under autocast."""
    position = voxel_position_embedding(h.grid, h.features.shape[1]).to(of.weight.dtype)
    return h.with_features(h.features + position)
