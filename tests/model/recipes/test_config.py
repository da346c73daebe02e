"""The published configurations: complete, and what they say of their networks."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from model.encoders.aggregator import AggregatorConfig, FeatureAggregator
from model.encoders.dino import DinoConfig
from model.encoders.wilor import WilorConfig
from model.errors import ModelError
from model.flow import UniformTime
from model.networks.lora import LoraSettings, add_lora
from model.recipes.components.component_identity import as_yaml
from model.recipes.components.vae_component import ImportedVae
from model.recipes.config import COMPONENT_NAMES, TrainingConfig, load_config, parse_config
from model.recipes.stage_one_config import StageOneTrainingConfig
from model.sparse_structure.dual_branch import DualBranchFlow
from model.sparse_structure.stage_one import StageOne
from model.sparse_structure.vae import StructureVae
from shards.settings import SettingsError
from tests.model.stages import stage_one

FOLDER = Path(__file__).resolve().parents[3] / "configs" / "model"
NAMES = sorted(path.stem for path in FOLDER.glob("*.yaml"))
STAGE_ONE = [n for n in NAMES if isinstance(load_config(FOLDER / f"{n}.yaml"), StageOneTrainingConfig)]


def loaded(name: str) -> StageOneTrainingConfig:
    return stage_one(load_config(FOLDER / f"{name}.yaml"))


def trained(config: TrainingConfig) -> list[str]:
    return [component.name for component in config.components() if component.recipe is not None]


def test_three_sizes_of_both_stages_and_the_packaged_hand_encoder_are_published():
    assert {"hands", "tiny", "small", "paper"} <= set(STAGE_ONE)
    assert {"tiny_slat", "small_slat", "paper_slat"} <= set(NAMES) - set(STAGE_ONE)


@pytest.mark.parametrize("name", NAMES)
def test_every_key_is_there_and_a_round_trip_changes_nothing(name):
    config = load_config(FOLDER / f"{name}.yaml")
    assert config.name == name
    assert parse_config(as_yaml(config), where="again") == config


@pytest.mark.parametrize("name", STAGE_ONE)
def test_networks_can_be_built_and_a_latent_decodes_to_64_voxels(name):
    config = loaded(name)
    with torch.device("meta"):
        DualBranchFlow(config.stage_one.network)
        vae = StructureVae(config.vae.network)
        logits = vae.decoder(torch.empty(1, *config.stage_one.network.geometry.latent_shape))
    assert logits.shape == (1, 64, 64, 64)


def test_components_come_after_those_that_they_stand_on_and_are_named_after_their_sections():
    seen: list[str] = []
    for name in ("small", "small_slat"):
        config = load_config(FOLDER / f"{name}.yaml")
        for component in config.components():
            assert {earlier.name for earlier in component.stands_on} <= set(seen)
            assert component.recipe == getattr(config, component.name).recipe
            seen.append(component.name)
    assert tuple(seen) == COMPONENT_NAMES


def test_what_has_weights_is_not_trained():
    assert trained(loaded("tiny")) == ["vae", "stage_one"]
    assert trained(loaded("small")) == ["vae", "hand_encoder", "stage_one"]
    assert trained(loaded("paper")) == ["stage_one"]
    assert trained(load_config(FOLDER / "tiny_slat.yaml")) == ["slat_vae", "slat_flow"]
    assert trained(load_config(FOLDER / "paper_slat.yaml")) == ["slat_flow"]
    assert [component.name for component in loaded("paper").components()] == ["vae", "stage_one"]


def test_paper_is_the_setting_of_section_4_1():
    config = loaded("paper")
    section, recipe = config.stage_one, config.stage_one.recipe
    assert section.lora == LoraSettings(rank=64, alpha=128, dropout=0.0)
    assert section.time == UniformTime()
    assert section.drop_condition == 0.1
    assert recipe.optimizer.learning_rate == 5e-4
    assert recipe.optimizer.weight_decay == 0.0  # Adam, not AdamW
    assert recipe.batch_size == 32
    assert recipe.views == (2, 6)
    assert recipe.image_size == 518
    assert isinstance(config.encoders.image, DinoConfig)
    assert config.encoders.image.image_size == 518
    assert section.network.masks.grid == 37
    assert isinstance(config.encoders.hand, WilorConfig)
    assert config.encoders.hand.image_size == 224
    assert isinstance(config.vae, ImportedVae)
    assert section.start is not None
    assert section.start.weights == config.vae.weights


def test_paper_trains_the_adapters_and_the_new_modules():
    """20.4 M in the adapters (FORMATS 4.3); the rest is the mask branch, its exchange and the aggregator."""
    section = loaded("paper").stage_one
    sizes = AggregatorConfig(
        image_channels=1024,
        image_grid=37,
        hand_channels=1280,
        hand_grid=14,
        hand_width=section.hand_width,
        hidden=section.hidden,
        channels=section.network.masks.feature_channels,
    )
    assert section.lora is not None
    with torch.device("meta"):
        network = StageOne(FeatureAggregator(sizes), section.network)
        add_lora(network.flow.geometry, section.lora)
    counts: dict[str, int] = {}
    for name, parameter in network.named_parameters():
        group = ".".join(name.split(".")[:2]) if name.startswith("flow.") else "aggregator"
        counts[group] = counts.get(group, 0) + parameter.numel() * parameter.requires_grad
    assert counts["flow.geometry"] == 20_447_232
    assert sum(counts.values()) == pytest.approx(320e6, rel=0.05)


def test_small_needs_no_weights_of_others():
    config = loaded("small")
    assert config.stage_one.start is None
    assert config.vae.network.latent_shape(64) == (8, 16, 16, 16)
    assert config.stage_one.network.masks.grid == 16
    with torch.device("meta"):
        flow = DualBranchFlow(config.stage_one.network)
    assert sum(p.numel() for p in flow.parameters()) == pytest.approx(19e6, rel=0.1)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("held_out_cameras: 0.25", "held_out_cameras: 0.0", "data.held_out_cameras is 0"),
        ("held_out_cameras: 0.25", "held_out_cameras: 1.0", "0 <= share < 1"),
        ("    batch_size: 6", "    batch_size: 0", "'stage_one.recipe.batch_size': expected between 1 and"),
        ("views: [2, 3]", "views: [3, 2]", "'stage_one.recipe.views': expected .lowest, highest."),
        (
            "    image_size: 128\n",
            "    image_size: 0\n",
            "'stage_one.recipe.image_size': expected between 8 and",
        ),
        ("guidance: null", "guidance: {strength: 0.0, interval: [0.5, 1.0]}", "`guidance: null` for none"),
        ("guidance: null", "guidance: {strength: 1.0, interval: [0.5, 1.5]}", "each between 0 and 1"),
        ("drop_condition: 0.1", "drop_condition: 1.7", "between 0 and 1"),
        ("drop_condition: 0.1", "drop_condition: -0.1", "between 0 and 1"),
        ("beta: 1.0", "beta: -1.0", "between 0 and 1,000,000.0"),
        ("batches: 8", "batches: 0", "between 1 and 1,000,000"),
    ],
)
def test_what_cannot_train_or_measure_is_refused(old, new, expected):
    text = (FOLDER / "tiny.yaml").read_text()
    assert text.count(old) == 1
    with pytest.raises((ModelError, SettingsError), match=expected):
        parse_config(text.replace(old, new), where="tiny")


@pytest.mark.parametrize(("name", "grid"), [("tiny", 16), ("paper", 37)])
def test_mask_tokens_lie_on_the_tokens_of_any_image_encoder(name, grid):
    config = loaded(name)
    network = config.stage_one.network
    assert network.masks.grid == config.encoders.image.grid == grid
    other = replace(network, masks=replace(network.masks, grid=grid - 1))
    with pytest.raises(ValueError, match=f"masks.grid is {grid - 1} and the grid of encoders.image {grid}:"):
        replace(config, stage_one=replace(config.stage_one, network=other))


def test_guidance_needs_a_dropped_condition_and_adapters_no_dropout():
    section = loaded("paper").stage_one
    with pytest.raises(ValueError, match="drop_condition > 0"):
        replace(section, drop_condition=0.0)
    with pytest.raises(ValueError, match="a resume would not be exact"):
        replace(section, lora=LoraSettings(rank=64, alpha=128, dropout=0.1))
