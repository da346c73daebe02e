"""The whole configuration of a training, of either stage: YAML that is complete once merged, every key checked.

Each section is a dataclass beside the code it configures; `stage_one_config` and `stage_two_config` assemble them.
"""

from pathlib import Path

from model.recipes.components.hand_encoder_component import HandEncoderComponent
from model.recipes.components.slat_flow_component import SlatFlowComponent
from model.recipes.components.slat_vae_component import SlatVaeComponent
from model.recipes.components.stage_one_component import StageOneComponent
from model.recipes.components.vae_component import VaeComponent
from model.recipes.stage_one_config import StageOneTrainingConfig
from model.recipes.stage_two_config import StageTwoTrainingConfig
from shards.configuration.layers import MergedSettings, read_layers
from shards.configuration.strict_yaml import parse_yaml
from shards.settings import Origins, settings_from_dict

__all__ = [
    "COMPONENT_NAMES",
    "PRESETS",
    "TrainingConfig",
    "load_config",
    "parse_config",
    "read_settings",
]

_STAGE_ONE = (VaeComponent, HandEncoderComponent, StageOneComponent)
_STAGE_TWO = (SlatVaeComponent, SlatFlowComponent)
COMPONENT_NAMES = tuple(component.name for component in (*_STAGE_ONE, *_STAGE_TWO))

TrainingConfig = StageOneTrainingConfig | StageTwoTrainingConfig

PRESETS = (Path(__file__).parents[1] / "presets").resolve()


def load_config(name: str | Path) -> TrainingConfig:
    """The configuration in a preset or a file; SettingsError names file, key, expected and found."""
    merged = read_settings(name)
    return _from_settings(merged.data, where=merged.origins)


def parse_config(text: str, *, where: str) -> TrainingConfig:
    """A complete configuration from YAML text, e.g. of a checkpoint; `where` names it in errors. SettingsError."""
    return _from_settings(parse_yaml(text, where=where), where=where)


def _from_settings(settings: object, *, where: str | Origins) -> TrainingConfig:
    """Of stage 2 where one of its sections is there."""
    if isinstance(settings, dict) and settings.keys() & {component.name for component in _STAGE_TWO}:
        return settings_from_dict(StageTwoTrainingConfig, settings, where=where)
    return settings_from_dict(StageOneTrainingConfig, settings, where=where)


def read_settings(name: str | Path) -> MergedSettings:
    """Content of a preset, `tiny`, or a file, `path/to/own.yaml`, merged with what it extends. SettingsError."""
    return read_layers(name, PRESETS, parse_yaml)
