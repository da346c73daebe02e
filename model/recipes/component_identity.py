"""What decides the weights of a part: its configuration, and the parts and files that it stands on.

The content of the data decides them too, but where they lie does not, and a network is used where they are not: a
checkpoint has the digest of its data beside that of its configuration (`TrainingState`), for training alone to check.
"""

import hashlib
from dataclasses import replace
from typing import TypeVar

from model.data.config import StreamConfig
from model.encoders.hand import packaged_hand_sha256
from model.recipes.config import (
    EncodersConfig,
    HandPart,
    ImportedVae,
    PackagedHandEncoder,
    Recipe,
    StageOnePart,
    TrainingConfig,
    VaePart,
    as_yaml,
)
from model.weights.weight_file import weights_sha256

__all__ = ["deciding_data", "deciding_recipe", "encoder_digests", "part_sha256", "sha256_of"]

_Part = TypeVar("_Part", VaePart, HandPart, StageOnePart)


def part_sha256(name: str, config: TrainingConfig) -> str:
    """Changes with anything that decides what training a part gives. ModelError when a weight file is missing."""
    data, vae, start = deciding_data(config.data), config.vae, config.stage_one.start
    vae_text = as_yaml(vae if isinstance(vae, ImportedVae) else _deciding(vae))
    hand = config.hand_encoder
    hand_text = "null" if hand is None else as_yaml(_deciding(hand))
    if name == "vae":
        return sha256_of(vae_text, as_yaml(data))
    if name == "hand_encoder":
        return sha256_of(hand_text, as_yaml(data))
    weights = [vae.weights] if isinstance(vae, ImportedVae) else []
    weights += [start.weights] if start is not None else []
    texts = [
        as_yaml(_deciding(config.stage_one)),
        as_yaml(config.encoders),
        vae_text,
        hand_text,
        as_yaml(data),
    ]
    return sha256_of(*texts, *encoder_digests(config.encoders), *(weights_sha256(path) for path in weights))


def sha256_of(*texts: str) -> str:
    """Digest of texts in their order."""
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()


def deciding_data(data: StreamConfig) -> StreamConfig:
    """The data without where they lie, without what says only how they are loaded and what recipes replace."""
    return replace(
        data,
        datasets=("",),
        workers=0,
        prefetch_batches=1,
        cache_mb=0,
        max_corrupt=0,
        batch_size=1,
        views=(1, 1),
        image_size=1,
    )


def deciding_recipe(recipe: Recipe) -> Recipe:
    """The recipe without its bookkeeping."""
    trainer = replace(recipe.trainer, checkpoint_every=1, keep_checkpoints=1, validate_every=1, log_every=1)
    return replace(recipe, trainer=trainer)


def encoder_digests(encoders: EncodersConfig) -> tuple[str, ...]:
    """Digest of the packaged hand encoder, if it is used: it may change with the package."""
    if not isinstance(encoders.hand, PackagedHandEncoder):
        return ()
    return (packaged_hand_sha256(),)


def _deciding(part: _Part) -> _Part:
    return replace(part, recipe=deciding_recipe(part.recipe))
