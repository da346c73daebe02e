"""The configured image encoder, as features of voxels are made with it."""

import hashlib
from dataclasses import dataclass, replace

import torch

from model.encoders.cached import uncached
from model.encoders.dino import DinoEncoder
from model.encoders.efficientnet import EfficientNetEncoder
from model.encoders.protocol import FeatureEncoder
from model.errors import ModelError

__all__ = ["ViewEncoder", "view_encoder"]


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewEncoder:
    """An encoder, and what its features are known by."""

    encoder: FeatureEncoder
    digest: str  # of its weights, kind and sizes


def view_encoder(conditioning: FeatureEncoder) -> ViewEncoder:
    """Shares the network of the encoder that conditions; DINOv2's tokens go without their last layer norm.

    TRELLIS conditions on layer-normed tokens, but its SLat encoder reads them as they are (FORMATS 4.5). ModelError
    for an encoder of another kind than the configurations know.
    """
    inner = uncached(conditioning)
    if not isinstance(inner, DinoEncoder | EfficientNetEncoder):
        raise ModelError(
            "view features",
            f"cannot be made with a {type(inner).__name__}",
            expected="DINOv2 or EfficientNet",
            action="Choose one of them as encoders.image.",
        )
    digest = hashlib.sha256(f"{type(inner).__name__} {inner.config.image_size} {inner.grid};".encode())
    network = inner.network if isinstance(inner, DinoEncoder) else inner.pyramid
    for name, tensor in sorted(network.state_dict().items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)};".encode())
        digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    encoder = replace(inner, normed=False) if isinstance(inner, DinoEncoder) else inner
    return ViewEncoder(encoder=encoder, digest=digest.hexdigest())
