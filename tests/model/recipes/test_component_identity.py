"""A run goes on under other loading and bookkeeping, and under nothing else."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from model.recipes.component_identity import part_sha256
from model.recipes.config import TrainingConfig, load_config
from model.recipes.slat_components import SLAT_PARTS, slat_part_sha256
from model.recipes.slat_config import SlatTrainingConfig, load_any_config

CONFIGS = Path(__file__).resolve().parents[3] / "configs" / "model"
LOADING: dict[str, Any] = {"workers": 3, "prefetch_batches": 9, "cache_mb": 1, "max_corrupt": 7}


def tiny() -> TrainingConfig:
    return load_config(CONFIGS / "tiny.yaml")


def with_trainer(config: TrainingConfig, **changes: Any) -> TrainingConfig:
    recipe = config.stage_one.recipe
    changed = replace(recipe, trainer=replace(recipe.trainer, **changes))
    return replace(config, stage_one=replace(config.stage_one, recipe=changed))


@pytest.mark.parametrize("name", ["vae", "stage_one"])
def test_loading_and_bookkeeping_do_not_decide(name):
    config = tiny()
    expected = part_sha256(name, config)
    assert part_sha256(name, replace(config, data=replace(config.data, **LOADING))) == expected
    assert part_sha256(name, with_trainer(config, log_every=3, checkpoint_every=7)) == expected


def test_where_the_data_lie_does_not_decide():
    """What is in them does: see test_moved_data.py."""
    config = tiny()
    moved = replace(config, data=replace(config.data, datasets=("elsewhere", "s3://bucket/more")))
    assert part_sha256("stage_one", moved) == part_sha256("stage_one", config)


@pytest.mark.parametrize("change", [{"seed": 1}, {"held_out_cameras": 0.5}, {"split": "val"}])
def test_what_is_drawn_from_the_data_decides(change: dict[str, Any]):
    config = tiny()
    other = replace(config, data=replace(config.data, **change))
    assert part_sha256("vae", other) != part_sha256("vae", config)


def test_the_length_of_the_training_decides():
    assert part_sha256("stage_one", with_trainer(tiny(), steps=401)) != part_sha256("stage_one", tiny())


@pytest.mark.parametrize("name", SLAT_PARTS)
def test_stage_two_alike(name):
    config = load_any_config(CONFIGS / "tiny_slat.yaml")
    assert isinstance(config, SlatTrainingConfig)
    expected = slat_part_sha256(name, config)
    assert slat_part_sha256(name, replace(config, data=replace(config.data, **LOADING))) == expected
    assert slat_part_sha256(name, replace(config, data=replace(config.data, seed=1))) != expected
