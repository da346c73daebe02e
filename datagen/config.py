"""The whole configuration of a dataset: one complete YAML file, every key checked.

Each section is a dataclass beside the code it configures; this file only assembles
them, reads the YAML strictly and compares configurations.
"""

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import yaml

from datagen.annotation.rows import ShardConfig
from datagen.grasps.config import GraspConfig
from datagen.objects.targets.learning_targets import TargetsConfig
from datagen.plan.plan import PlanConfig
from datagen.plan.selection_rules import SelectionConfig
from datagen.sampling.config import SamplingConfig
from datagen.sources.hands import HandConfig, resolved_hand
from datagen.sources.motions import MotionsConfig
from datagen.sources.objects import ObjectsConfig
from datagen.version import generator_commit
from shards.settings import SettingsError, settings_from_dict
from shards.splits import SplitRule
from shards.storage.records import Provenance

__all__ = ["DatasetConfig", "config_as_yaml", "config_sha256", "load_config", "placeless", "provenance_of"]


@dataclass(frozen=True, kw_only=True)
class DatasetConfig:
    """One dataset, from objects to bytes.

    Complete whatever the source: what only another one reads (`motions.replay`, `objects.registration` and
    `selection.movement` with simulated motions, `grasp` with recorded ones) is there too, so that another
    source is a change of one word and no default decides anything.
    """

    name: str
    seed: int
    objects: ObjectsConfig
    motions: MotionsConfig
    selection: SelectionConfig
    hand: HandConfig
    plan: PlanConfig
    split: SplitRule
    grasp: GraspConfig
    sampling: SamplingConfig
    targets: TargetsConfig
    shard: ShardConfig

    def __post_init__(self) -> None:
        recorded = self.motions.source == "graspxl"
        if recorded != (self.objects.source == "graspxl"):
            raise ValueError(
                f"motions.source is {self.motions.source} with objects.source {self.objects.source}: "
                "recorded motions need the objects they were recorded with; expected graspxl for both or neither"
            )


def load_config(path: Path, *, licence_allow: tuple[str, ...] | None = None) -> DatasetConfig:
    """Read a complete YAML file; SettingsError names file, key, expected and found.

    `auto` settings are decided here, by what is on this machine, so that the configuration names
    what is really used. `licence_allow` takes the place of selection.licence_allow.
    """
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise SettingsError(
            f"{path}: no such configuration; configs/datagen holds tiny, small and paper"
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from error
    if not isinstance(data, dict):
        raise SettingsError(f"{path}: expected a mapping of settings, found {type(data).__name__}")
    config = settings_from_dict(DatasetConfig, data, where=str(path))
    selection = config.selection
    if selection.takedown is not None:
        selection = replace(selection, takedown=(path.parent / selection.takedown.expanduser()).resolve())
    if licence_allow is not None:
        selection = replace(selection, licence_allow=licence_allow)
    return replace(config, hand=resolved_hand(config.hand), selection=selection)


def config_as_yaml(config: DatasetConfig) -> str:
    """The complete configuration as it is stored in dataset.json; `load_config` reads it back."""
    plain = json.loads(json.dumps(asdict(config), default=str))
    return yaml.safe_dump(plain, sort_keys=False)


def config_sha256(config: DatasetConfig) -> str:
    """Changes when any setting that decides the data changes; where assets and caches lie does not."""
    return hashlib.sha256(config_as_yaml(placeless(config)).encode()).hexdigest()


def placeless(config: DatasetConfig) -> DatasetConfig:
    """The configuration without the places of files on this machine."""
    return replace(
        config,
        objects=replace(config.objects, path=None, cache_dir=None, objaverse_root=None),
        motions=replace(config.motions, graspxl_root=None),
        selection=replace(config.selection, takedown=None),
        hand=replace(config.hand, mano_dir=None, html_dir=None),
    )


def provenance_of(config: DatasetConfig) -> Provenance:
    """What made the data: this code and this configuration."""
    return Provenance(generator_commit=generator_commit(), config_sha256=config_sha256(config))
