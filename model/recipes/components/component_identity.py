"""What decides the weights of a component: its section of the configuration, and the components and files it stands on.

The content of the data decides them too, but where they lie does not, and a network is used where they are not: a
checkpoint has the digest of its data beside that of its configuration (`TrainingState`), for training alone to check.
"""

import hashlib
import json
from dataclasses import asdict, replace
from typing import TypeVar

import yaml

from model.data.config import DataConfig
from model.recipes.components.recipe import Recipe

__all__ = ["as_yaml", "deciding_data", "deciding_recipe", "sha256_of"]

_Recipe = TypeVar("_Recipe", bound=Recipe)


def sha256_of(*texts: str) -> str:
    """Digest of texts in their order."""
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()


def as_yaml(section: object) -> str:
    """A configuration, or a section of one, as text that `load_config` reads back."""
    return yaml.safe_dump(json.loads(json.dumps(asdict(section), default=str)), sort_keys=False)  # type: ignore[call-overload]


def deciding_data(data: DataConfig) -> DataConfig:
    """The data without where they lie, and without what says only how they are loaded."""
    return replace(data, datasets=("",), workers=0, prefetch_batches=1, cache_mb=0, max_corrupt=0)


def deciding_recipe(recipe: _Recipe) -> _Recipe:
    """The recipe without its bookkeeping."""
    trainer = replace(recipe.trainer, checkpoint_every=1, keep_checkpoints=1, validate_every=1, log_every=1)
    return replace(recipe, trainer=trainer)
