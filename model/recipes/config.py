"""The whole configuration of a training, of either stage: one complete YAML file, every key checked.

Each section is a dataclass beside the code it configures; `stage_one_config` and `stage_two_config` assemble them.
"""

from pathlib import Path

import yaml

from model.errors import ModelError
from model.recipes.components.hand_encoder_component import HandEncoderComponent
from model.recipes.components.slat_flow_component import SlatFlowComponent
from model.recipes.components.slat_vae_component import SlatVaeComponent
from model.recipes.components.stage_one_component import StageOneComponent
from model.recipes.components.vae_component import VaeComponent
from model.recipes.stage_one_config import StageOneTrainingConfig
from model.recipes.stage_two_config import StageTwoTrainingConfig
from shards.settings import SettingsError, settings_from_dict

__all__ = ["COMPONENT_NAMES", "TrainingConfig", "load_config", "parse_config", "parse_yaml", "read_yaml"]

_STAGE_ONE = (VaeComponent, HandEncoderComponent, StageOneComponent)
_STAGE_TWO = (SlatVaeComponent, SlatFlowComponent)
COMPONENT_NAMES = tuple(component.name for component in (*_STAGE_ONE, *_STAGE_TWO))

TrainingConfig = StageOneTrainingConfig | StageTwoTrainingConfig


def load_config(path: Path) -> TrainingConfig:
    """Read a complete YAML file; SettingsError names file, key, expected and found."""
    return _from_settings(read_yaml(path), where=str(path))


def parse_config(text: str, *, where: str) -> TrainingConfig:
    """A complete configuration from YAML text, e.g. of a checkpoint; `where` names it in errors. SettingsError."""
    return _from_settings(parse_yaml(text, where=where), where=where)


def _from_settings(settings: object, *, where: str) -> TrainingConfig:
    """Of stage 2 where one of its sections is there."""
    if isinstance(settings, dict) and settings.keys() & {component.name for component in _STAGE_TWO}:
        return settings_from_dict(StageTwoTrainingConfig, settings, where=where)
    return settings_from_dict(StageOneTrainingConfig, settings, where=where)


def read_yaml(path: Path) -> object:
    """Content of a configuration's file. ModelError when there is none, SettingsError when it is no YAML."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise ModelError(
            path, "does not exist", expected="a training configuration", action="See configs/model."
        ) from error
    except UnicodeDecodeError as error:
        raise SettingsError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from error
    return parse_yaml(text, where=str(path))


def parse_yaml(text: str, *, where: str) -> object:
    """Content of YAML text; `where` names it in errors. SettingsError."""
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise SettingsError(f"{where}: not valid YAML: {' '.join(str(error).split())}") from error
