"""A run resumes under other loading and bookkeeping, and under nothing else."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from model.recipes.components.vae_component import TrainedVae
from model.recipes.config import TrainingConfig, load_config
from model.recipes.stage_one_config import StageOneTrainingConfig
from tests.model.stages import stage_one

CONFIGS = Path(__file__).resolve().parents[4] / "configs" / "model"
LOADING: dict[str, Any] = {"workers": 3, "prefetch_batches": 9, "cache_mb": 1, "max_corrupt": 7}
NAMES = [("tiny", "vae"), ("tiny", "stage_one"), ("small", "hand_encoder"), ("small", "stage_one")]
NAMES += [("tiny_slat", "slat_vae"), ("tiny_slat", "slat_flow")]


def digest(config: TrainingConfig, name: str) -> str:
    return {component.name: component for component in config.components()}[name].sha256()


def tiny() -> StageOneTrainingConfig:
    return stage_one(load_config(CONFIGS / "tiny.yaml"))


def with_trainer(config: StageOneTrainingConfig, **changes: Any) -> StageOneTrainingConfig:
    recipe = config.stage_one.recipe
    changed = replace(recipe, trainer=replace(recipe.trainer, **changes))
    return replace(config, stage_one=replace(config.stage_one, recipe=changed))


@pytest.mark.parametrize(("config_name", "name"), NAMES)
def test_loading_and_the_place_of_the_data_do_not_decide_and_what_is_drawn_does(config_name, name):
    """What is in the data does, too: see test_moved_data.py."""
    config = load_config(CONFIGS / f"{config_name}.yaml")
    expected = digest(config, name)
    elsewhere = LOADING | {"datasets": ("elsewhere", "s3://bucket/more")}
    assert digest(replace(config, data=replace(config.data, **elsewhere)), name) == expected
    changes: list[dict[str, Any]] = [{"seed": 1}, {"held_out_cameras": 0.5}, {"split": "test"}]
    for change in changes:
        assert digest(replace(config, data=replace(config.data, **change)), name) != expected


def test_bookkeeping_does_not_decide_and_the_length_of_the_training_does():
    expected = digest(tiny(), "stage_one")
    assert digest(with_trainer(tiny(), log_every=3, checkpoint_every=7), "stage_one") == expected
    assert digest(with_trainer(tiny(), steps=401), "stage_one") != expected


def test_what_a_component_stands_on_decides():
    config = stage_one(load_config(CONFIGS / "small.yaml"))
    assert isinstance(config.vae, TrainedVae)
    before = {component.name: component.sha256() for component in config.components()}
    vae = replace(config.vae, turn=False)
    after = {component.name: component.sha256() for component in replace(config, vae=vae).components()}
    assert [name for name in before if before[name] != after[name]] == ["vae", "stage_one"]
