"""Stage 2 by its configuration on a small dataset: both components, exact resume, and what can go wrong."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from accelerate import Accelerator
from safetensors.torch import load_file

from model.data.stream import ShardStream
from model.errors import ModelError
from model.networks.lora import LoraSettings
from model.recipes.components.component import Component
from model.recipes.components.component_identity import as_yaml
from model.recipes.components.slat_vae_component import TrainedSlatVae
from model.recipes.config import load_config, parse_config, read_settings
from model.recipes.stage_two_config import StageTwoTrainingConfig
from model.recipes.train_component import train_component
from model.structured_latent.flow import SlatFlow
from model.structured_latent.vae.latent import LatentNormalisation
from model.training.checkpoint import latest_checkpoint
from model.training.trainer import StepReport, TrainingEvent
from model.weights.slat import SLAT_FLOW
from model.weights.weight_file import write_weight_file
from shards.settings import SettingsError
from tests.model.data.balls import write_balls
from tests.model.stages import stage_two

FOLDER = Path(__file__).resolve().parents[3] / "configs" / "model"
COMPONENTS = ("slat_vae", "slat_flow")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    return write_balls(tmp_path_factory.mktemp("balls"))


@pytest.fixture(scope="module")
def config(dataset) -> StageTwoTrainingConfig:
    """tiny_slat.yaml, cut down to seconds."""
    settings = read_settings("tiny_slat").data
    settings["data"] |= {
        "datasets": [str(dataset)],
        "workers": 0,
        "samples_per_motion": 4,
        "held_out_cameras": 0.4,
    }
    settings["validation"] |= {"views": 2, "batch_size": 1, "batches": 1}
    settings["encoders"]["image"] = {"image_size": 64, "grid": 8}
    settings["meshes"]["samples"] = 2000
    settings["slat_vae"]["network"] |= {"channels": 8, "blocks": 1}
    settings["slat_flow"]["network"] |= {
        "channels": 12,
        "heads": 1,
        "blocks": 1,
        "io_channels": [4, 8],
        "condition_channels": 12,
    }
    settings["slat_flow"]["sampler"]["steps"] = 2
    settings["slat_flow"]["recipe"] |= {"views": [1, 2], "image_size": 32}
    for component in COMPONENTS:
        recipe = settings[component]["recipe"]
        recipe["batch_size"] = 1
        recipe["trainer"] |= {"steps": 2, "checkpoint_every": 1, "validate_every": 2, "log_every": 1}
        recipe["trainer"]["precision"] = "float32"
    return stage_two(parse_config(yaml.safe_dump(settings), where="small"))


def component_of(config: StageTwoTrainingConfig, name: str) -> Component:
    return {component.name: component for component in config.components()}[name]


def train(name: str, config: StageTwoTrainingConfig, folder: Path) -> tuple[dict[str, float], list[int]]:
    events: list[TrainingEvent] = []
    metrics = train_component(
        component_of(config, name),
        config,
        folder,
        accelerator=Accelerator(cpu=True),
        report=events.append,
    )
    return metrics, [event.step for event in events if isinstance(event, StepReport)]


@pytest.fixture(scope="module")
def finished(config, tmp_path_factory) -> Path:
    """The run of both components. Do not change it."""
    folder = tmp_path_factory.mktemp("run")
    for name in COMPONENTS:
        metrics, steps = train(name, config, folder)
        assert steps == [1, 2]
        assert "f_5mm" in metrics
    return folder


def weights(folder: Path) -> dict[str, torch.Tensor]:
    newest = latest_checkpoint(folder / "checkpoints")
    assert newest is not None
    return load_file(newest / "weights.safetensors")


def test_a_finished_run_trains_nothing_and_gives_its_metrics(config, finished):
    before = weights(finished / "slat_flow")
    metrics, steps = train("slat_flow", config, finished)
    assert steps == []
    assert "mean_latent_f_5mm" in metrics
    after = weights(finished / "slat_flow")
    assert all(torch.equal(before[name], after[name]) for name in before)


@pytest.mark.parametrize("name", COMPONENTS)
def test_a_run_that_was_stopped_ends_where_one_without_a_stop_does(name, config, finished, tmp_path):
    (tmp_path / "slat_vae").symlink_to(finished / "slat_vae") if name == "slat_flow" else None
    _stop_after_one_step(name, config, tmp_path)
    _, steps = train(name, config, tmp_path)
    assert steps == [2]
    ours, theirs = weights(tmp_path / name), weights(finished / name)
    assert all(torch.equal(ours[key], theirs[key]) for key in theirs)


def _stop_after_one_step(name: str, config: StageTwoTrainingConfig, folder: Path) -> None:
    class StopError(Exception):
        pass

    def stop(report) -> None:
        if report.step == 2:
            raise StopError

    with pytest.raises(StopError):
        train_component(
            component_of(config, name), config, folder, accelerator=Accelerator(cpu=True), report=stop
        )


def test_the_trained_flow_predicts_from_images(config, finished):
    task = config.flow.load(finished, torch.device("cpu"))
    stream = ShardStream(replace(config.slat_flow.recipe.stream(config.data, surface=False), views=(2, 2)))
    batch = next(iter(stream))
    prediction = task.predict(batch.images, batch.occupancy, torch.Generator().manual_seed(0))
    assert prediction.fields(0).resolution == 64
    assert torch.isfinite(prediction.decoded.features).all()


def test_a_flow_with_adapters_is_used_with_the_weights_that_it_started_from(config, finished, tmp_path):
    published = SlatFlow(config.slat_flow.network)
    start = tmp_path / "start.safetensors"
    tensors = {f"{SLAT_FLOW}{name}": value for name, value in published.state_dict().items()}
    normalisation = LatentNormalisation.identity(config.slat_flow.network.latent_channels).state_dict()
    tensors |= {f"stage_two.normalisation.{name}": value for name, value in normalisation.items()}
    write_weight_file(start, tensors, sources={})
    section = replace(config.slat_flow, start=start, lora=LoraSettings(rank=2, alpha=4))
    adapted = replace(config, slat_flow=section)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "slat_vae").symlink_to(finished / "slat_vae")
    _, steps = train("slat_flow", adapted, tmp_path / "run")
    assert steps == [1, 2]
    flow = adapted.flow.load(tmp_path / "run", torch.device("cpu")).network.flow
    held = flow.state_dict()
    assert any("lora_A" in name for name in held)
    name = "blocks.0.mlp.mlp.0.weight"
    torch.testing.assert_close(held[name], published.state_dict()[name], rtol=0, atol=0)


def test_the_flow_without_its_vae_says_what_to_train(config, tmp_path):
    with pytest.raises(ModelError, match="forehoi train slat_vae"):
        train("slat_flow", config, tmp_path)


def test_the_vae_of_another_configuration_is_refused(config, finished):
    section = config.slat_vae
    assert isinstance(section, TrainedSlatVae)
    other = replace(config, slat_vae=replace(section, loss=replace(section.loss, kl=0.5)))
    with pytest.raises(ModelError, match="another configuration"):
        train("slat_flow", other, finished)


def test_the_hand_encoder_of_stage_one_is_refused(config, finished):
    text = as_yaml(config).replace("packaged_grid", "own_grid")
    with pytest.raises(ModelError, match="packaged_grid"):
        stage_two(parse_config(text, where="own")).flow.load(finished, torch.device("cpu"))


def test_contradictions_name_both_sides(config):
    text = as_yaml(config)
    with pytest.raises(SettingsError, match="feature_channels is 10"):
        parse_config(text.replace("feature_channels: 16", "feature_channels: 10"), where="file")
    bad = yaml.safe_load(text)
    bad["slat_flow"]["network"]["latent_channels"] = 4
    with pytest.raises(SettingsError, match="takes 4 channels"):
        parse_config(yaml.safe_dump(bad), where="file")
    with pytest.raises(SettingsError, match="slat_flo"):
        parse_config(text.replace("slat_flow:", "slat_flo:"), where="file")
    with pytest.raises(SettingsError, match="no such configuration"):
        load_config(FOLDER / "nothing.yaml")
