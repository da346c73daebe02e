"""The whole configuration of a dataset: YAML that is complete once merged, every key checked.

Each section is a dataclass beside the code it configures; this file only assembles
them, reads the YAML strictly and compares configurations.
"""

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

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
from shards.configuration.layers import read_layers
from shards.configuration.strict_yaml import parse_yaml
from shards.settings import Range, settings_from_dict
from shards.splits import SplitRule
from shards.storage.records import Provenance

__all__ = [
    "PRESETS",
    "DatasetConfig",
    "config_as_yaml",
    "config_sha256",
    "load_config",
    "placeless",
    "provenance_of",
    "read_config",
]

PRESETS = (Path(__file__).parent / "presets").resolve()


@dataclass(frozen=True, kw_only=True)
class DatasetConfig:
    """One dataset, from objects to bytes.

    Complete whatever the source: what only another one reads (`motions.replay`, `objects.registration` and
    `selection.movement` with simulated motions, `grasp` with recorded ones) is there too, so that another
    source is a change of one word and no default decides anything.
    """

    name: str
    seed: Annotated[int, Range(0, 2**63 - 1)]
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


def load_config(name: str | Path, *, licence_allow: tuple[str, ...] | None = None) -> DatasetConfig:
    """The configuration of a preset or of a file (see `read_config`), as it is used on this machine.

    `auto` settings are decided here, by what is on this machine, so that the configuration names
    what is really used. `licence_allow` takes the place of selection.licence_allow.
    """
    config = read_config(name)
    if licence_allow is not None:
        config = replace(config, selection=replace(config.selection, licence_allow=licence_allow))
    return replace(config, hand=resolved_hand(config.hand))


def read_config(name: str | Path) -> DatasetConfig:
    """The configuration as it is written in a preset, `tiny`, or a file, `path/to/own.yaml`, and what it extends.

    SettingsError names file, key, expected and found.
    """
    merged = read_layers(name, PRESETS, parse_yaml)
    config = settings_from_dict(DatasetConfig, merged.data, where=merged.origins)
    selection = config.selection
    if selection.takedown is not None:
        beside = Path(merged.origins["selection.takedown"]).parent
        selection = replace(selection, takedown=(beside / selection.takedown.expanduser()).resolve())
    return replace(config, selection=selection)


def config_as_yaml(config: DatasetConfig) -> str:
    """The complete configuration as it is stored in dataset.json; `read_config` reads it back."""
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
