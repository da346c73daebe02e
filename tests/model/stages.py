"""Configurations as those of one stage."""

from model.recipes.config import TrainingConfig
from model.recipes.stage_one_config import StageOneTrainingConfig
from model.recipes.stage_two_config import StageTwoTrainingConfig

__all__ = ["stage_one", "stage_two"]


def stage_one(config: TrainingConfig) -> StageOneTrainingConfig:
    """The same one, if it is of stage 1."""
    assert isinstance(config, StageOneTrainingConfig)
    return config


def stage_two(config: TrainingConfig) -> StageTwoTrainingConfig:
    """The same one, if it is of stage 2."""
    assert isinstance(config, StageTwoTrainingConfig)
    return config
