"""Frozen features kept in memory, for runs whose crops repeat exactly.

Of use without augmentation only (overfitting one motion, validation): a turned or shifted crop is another
image. Images are recognised by their content, so a crop can never get the features of another.

Training asks under autocast, validation without. So that kept features do not depend on who asked first, the encoder
always runs as it is, in the type of its own weights, and gives the type of the images.
"""

import hashlib
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from model.encoders.protocol import FeatureEncoder

__all__ = ["CachedEncoder", "uncached"]


@dataclass(frozen=True, kw_only=True, eq=False)
class CachedEncoder:
    """Another encoder that computes each image once. Not shared between processes."""

    encoder: FeatureEncoder
    max_views: int
    """Images to keep; later ones are computed each time. One costs 4 * grid^2 * channels bytes in float32."""
    _kept: dict[bytes, Tensor] = field(default_factory=dict, init=False, repr=False)

    @property
    def grid(self) -> int:
        return self.encoder.grid

    @property
    def channels(self) -> int:
        return self.encoder.channels

    def to(self, device: torch.device | str, dtype: torch.dtype) -> "CachedEncoder":
        self._kept.clear()
        self.encoder.to(device, dtype)
        return self

    def __call__(
        self, images: Float[Tensor, "batch view 3 size size"]
    ) -> Float[Tensor, "batch view token channel"]:
        views = images.flatten(0, 1)
        keys = [_content(view) for view in views]
        tokens = {key: self._kept[key] for key in keys if key in self._kept}
        if new := {key: index for index, key in enumerate(keys) if key not in tokens}:
            with torch.autocast(images.device.type, enabled=False):
                computed = self.encoder(views[list(new.values())][None])[0].to(images.dtype)
            for key, value in zip(new, computed):
                tokens[key] = value
                if len(self._kept) < self.max_views:
                    self._kept[key] = value.clone()  # a row would keep the whole batch alive
        return torch.stack([tokens[key] for key in keys]).unflatten(0, images.shape[:2])


def uncached(encoder: FeatureEncoder) -> FeatureEncoder:
    """The encoder below the cache, or the same one."""
    return encoder.encoder if isinstance(encoder, CachedEncoder) else encoder


def _content(view: Float[Tensor, "3 size size"]) -> bytes:
    data = view.detach().cpu().contiguous().view(torch.uint8).numpy()
    return hashlib.blake2b(data.tobytes(), digest_size=16, salt=str(view.dtype)[-8:].encode()).digest()
