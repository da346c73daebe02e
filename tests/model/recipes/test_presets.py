"""Presets, files that extend them, and what `forehoi config` prints."""

import re
from dataclasses import replace
from textwrap import dedent

import pytest

from model.encoders.dino import DinoConfig
from model.flow import UniformTime
from model.recipes.config import PRESETS, load_config
from model.recipes.stage_one_config import StageOneTrainingConfig
from shards.configuration.presets import preset_names
from tests.model.small_run import ROOT, fails, forehoi

NAMES = preset_names(PRESETS)
ABLATION = """\
extends: tiny
name: no_masks
stage_one:
  beta: 0.0
  recipe: {trainer: {seed: 1}}
"""
OTHER_KIND = """\
extends: tiny
name: dino
stage_one: {network: {masks: {grid: 10}}}
encoders:
  image: !replace {source: facebook/dinov2-with-registers-small, image_size: 140, local_files_only: true}
"""


@pytest.mark.parametrize("name", NAMES)
def test_what_is_printed_reads_back_as_the_same_configuration(name, tmp_path):
    config = load_config(name)
    assert config.name == name
    status, text = forehoi("config", name)
    assert status == 0
    assert "extends" not in text
    (tmp_path / "printed.yaml").write_text(text)
    assert load_config(tmp_path / "printed.yaml") == config


@pytest.mark.parametrize("name", NAMES)
def test_a_preset_does_not_differ_from_itself(name):
    assert forehoi("config", name, "--diff", PRESETS / f"{name}.yaml") == (0, "")


def test_an_ablation_is_five_lines(tmp_path):
    path = tmp_path / "no_masks.yaml"
    path.write_text(ABLATION)
    tiny = load_config("tiny")
    assert isinstance(tiny, StageOneTrainingConfig)
    section, recipe = tiny.stage_one, tiny.stage_one.recipe
    recipe = replace(recipe, trainer=replace(recipe.trainer, seed=1))
    assert load_config(path) == replace(
        tiny, name="no_masks", stage_one=replace(section, beta=0.0, recipe=recipe)
    )
    status, text = forehoi("config", path, "--diff", "tiny")
    assert status == 0
    assert text.splitlines() == [
        'name: "tiny" -> "no_masks"',
        "stage_one.beta: 1.0 -> 0.0",
        "stage_one.recipe.trainer.seed: 0 -> 1",
    ]


def test_a_section_of_another_kind_is_replaced(tmp_path):
    path = tmp_path / "dino.yaml"
    path.write_text(OTHER_KIND)
    config = load_config(path)
    assert isinstance(config, StageOneTrainingConfig)
    assert isinstance(config.encoders.image, DinoConfig)
    path.write_text(OTHER_KIND.replace("!replace ", ""))
    line = fails("config", path)
    assert f"{path}: 'encoders.image' fits none of its forms" in line
    assert f"`image: !replace` takes only what stands in {path}" in line


def test_mistakes_name_the_file_and_unknown_presets_the_known(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text("extends: small\nstage_one: {beat: 2.0}\n")
    assert f"{path}: unknown key 'stage_one.beat' (did you mean 'beta'?)" in fails("train", path)
    line = fails("train", "tiny_slta")
    assert "tiny_slta: neither a preset nor a component (did you mean 'tiny_slat'?)" in line
    assert ", ".join(NAMES) in line
    assert "(did you mean 'stage_one'?)" in fails("train", "stage_on")


def test_the_examples_of_the_readme_are_configurations(tmp_path):
    own, sections = re.findall(r"```yaml\n(.*?)```", (ROOT / "configs" / "README.md").read_text(), re.DOTALL)
    path = tmp_path / "own.yaml"
    path.write_text(own)
    assert "stage_one.beta: 1.0 -> 0.0" in forehoi("config", path, "--diff", "tiny")[1].splitlines()
    path.write_text("extends: tiny\n" + dedent(sections))
    config = load_config(path)
    assert isinstance(config.encoders.image, DinoConfig)
    assert config.stage_one.time == UniformTime()
