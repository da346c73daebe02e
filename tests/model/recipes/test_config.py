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
from model.recipes.components import trained_parts
from model.recipes.config import ImportedVae, TrainingConfig, as_yaml, load_config, parse_config
from model.sparse_structure.dual_branch import DualBranchFlow
from model.sparse_structure.stage_one import StageOne
from model.sparse_structure.vae import StructureVae
from shards.settings import SettingsError

FOLDER = Path(__file__).resolve().parents[3] / "configs" / "model"
NAMES = sorted(path.stem for path in FOLDER.glob("*.yaml") if not path.stem.endswith("_slat"))


def loaded(name: str) -> TrainingConfig:
    return load_config(FOLDER / f"{name}.yaml")


@pytest.mark.parametrize("name", NAMES)
def test_every_key_is_there_and_a_round_trip_changes_nothing(name):
    config = loaded(name)
    assert config.name == name
    assert parse_config(as_yaml(config), where="again") == config


@pytest.mark.parametrize("name", NAMES)
def test_networks_can_be_built_and_a_latent_decodes_to_64_voxels(name):
    config = loaded(name)
    with torch.device("meta"):
        DualBranchFlow(config.stage_one.network)
        vae = StructureVae(config.vae.network)
        logits = vae.decoder(torch.empty(1, *config.stage_one.network.geometry.latent_shape))
    assert logits.shape == (1, 64, 64, 64)


def test_three_sizes_and_the_packaged_hand_encoder_are_published():
    assert set(NAMES) == {"hands", "tiny", "small", "paper"}


def test_paper_is_the_setting_of_section_4_1():
    config = loaded("paper")
    part, recipe = config.stage_one, config.stage_one.recipe
    assert part.lora == LoraSettings(rank=64, alpha=128, dropout=0.0)
    assert part.time == UniformTime()
    assert part.drop_condition == 0.1
    assert recipe.optimizer.learning_rate == 5e-4
    assert recipe.optimizer.weight_decay == 0.0  # Adam, not AdamW
    assert recipe.batch_size == 32
    assert recipe.views == (2, 6)
    assert recipe.image_size == 518
    assert isinstance(config.encoders.image, DinoConfig)
    assert config.encoders.image.image_size == 518
    assert part.network.masks.grid == 37
    assert isinstance(config.encoders.hand, WilorConfig)
    assert config.encoders.hand.image_size == 224
    assert isinstance(config.vae, ImportedVae)
    assert part.start is not None
    assert part.start.weights == config.vae.weights
    assert trained_parts(config) == ("stage_one",)


def test_paper_trains_the_adapters_and_the_new_modules():
    """20.4 M in the adapters (FORMATS 4.3); the rest is the mask branch, its exchange and the aggregator."""
    part = loaded("paper").stage_one
    sizes = AggregatorConfig(
        image_channels=1024,
        image_grid=37,
        hand_channels=1280,
        hand_grid=14,
        hand_width=part.hand_width,
        hidden=part.hidden,
        channels=part.network.masks.feature_channels,
    )
    assert part.lora is not None
    with torch.device("meta"):
        network = StageOne(FeatureAggregator(sizes), part.network)
        add_lora(network.flow.geometry, part.lora)
    counts: dict[str, int] = {}
    for name, parameter in network.named_parameters():
        group = ".".join(name.split(".")[:2]) if name.startswith("flow.") else "aggregator"
        counts[group] = counts.get(group, 0) + parameter.numel() * parameter.requires_grad
    assert counts["flow.geometry"] == 20_447_232
    assert sum(counts.values()) == pytest.approx(320e6, rel=0.05)


def test_small_needs_no_weights_of_others():
    config = loaded("small")
    assert trained_parts(config) == ("vae", "hand_encoder", "stage_one")
    assert config.stage_one.start is None
    assert config.vae.network.latent_shape(64) == (8, 16, 16, 16)
    assert config.stage_one.network.masks.grid == 16
    with torch.device("meta"):
        flow = DualBranchFlow(config.stage_one.network)
    assert sum(p.numel() for p in flow.parameters()) == pytest.approx(19e6, rel=0.1)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("endless: true", "endless: false", "data.endless is false"),
        ("cameras: train", "cameras: all", "data.cameras is all"),
        ("drop_condition: 0.1", "drop_condition: 1.7", "a share below 1"),
        ("drop_condition: 0.1", "drop_condition: -0.1", "a share below 1"),
        ("beta: 1.0", "beta: -1.0", "beta >= 0"),
        ("batches: 8", "batches: 0", "below 1"),
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
    part = loaded("paper").stage_one
    with pytest.raises(ValueError, match="drop_condition > 0"):
        replace(part, drop_condition=0.0)
    with pytest.raises(ValueError, match="a resume would not be exact"):
        replace(part, lora=LoraSettings(rank=64, alpha=128, dropout=0.1))
