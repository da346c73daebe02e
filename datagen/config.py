"""The whole configuration of a dataset: one complete YAML file, every key checked.

Each section is a dataclass beside the code it configures; this file only assembles
them, reads the YAML strictly and compares configurations.
"""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import yaml

from datagen.grasps.config import GraspConfig
from datagen.library import ObjectsConfig
from datagen.objects.fields import TargetsConfig
from datagen.pack import ShardConfig
from datagen.plan import PlanConfig
from datagen.sampling.config import SamplingConfig
from shards.settings import SettingsError, settings_from_dict
from shards.splits import SplitRule

__all__ = ["DatasetConfig", "config_as_json", "config_hash", "load_config"]


@dataclass(frozen=True, kw_only=True)
class DatasetConfig:
    """One dataset, from objects to bytes."""

    name: str
    seed: int
    objects: ObjectsConfig
    plan: PlanConfig
    split: SplitRule
    grasp: GraspConfig
    sampling: SamplingConfig
    targets: TargetsConfig
    shard: ShardConfig


def load_config(path: Path) -> DatasetConfig:
    """Read a complete YAML file; SettingsError names file, key, expected and found."""
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise SettingsError(f"{path}: no such configuration; configs/datagen holds tiny, small and paper") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from error
    if not isinstance(data, dict):
        raise SettingsError(f"{path}: expected a mapping of settings, found {type(data).__name__}")
    return settings_from_dict(DatasetConfig, data, where=str(path))


def config_as_json(config: DatasetConfig) -> dict[str, Any]:
    """The configuration as plain JSON values, as stored in dataset.json."""
    plain: dict[str, Any] = json.loads(json.dumps(asdict(config), default=str))
    return plain


def config_hash(config: DatasetConfig) -> str:
    """Sixteen hex digits that change when any setting that decides the data changes.

    Where assets and caches lie on this machine does not decide the data.
    """
    plain = config_as_json(config)
    del plain["objects"]["cache_dir"]
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]


def first_difference(a: Any, b: Any, key: str = "") -> str:
    """The first dotted key in which two JSON values differ, with both values; '' if none."""
    if isinstance(a, dict) and isinstance(b, dict):
        for name in sorted(a.keys() | b.keys()):
            found = first_difference(a.get(name), b.get(name), f"{key}.{name}" if key else name)
            if found:
                return found
        return ""
    return "" if a == b else f"{key}: {a!r} there, {b!r} here"
