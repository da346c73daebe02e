"""Stage 2 trained on image features of the clean objects, with the open image encoder: both components, end to end."""

import math
from pathlib import Path

import pytest
import torch
import yaml
from accelerate import Accelerator

from model.recipes.config import parse_config, read_settings
from model.recipes.stage_two_config import StageTwoTrainingConfig
from model.recipes.train_component import train_component
from model.training.trainer import StepReport, TrainingEvent
from tests.model.stages import stage_two
from tests.model.structured_latent.object_features.textured_ball import write_textured_balls

STEPS = {"slat_vae": 24, "slat_flow": 3}


def small_config(dataset: Path, cache: Path | None) -> StageTwoTrainingConfig:
    """tiny_slat.yaml with features of views, cut down to seconds; flips are on."""
    settings = read_settings("tiny_slat").data
    settings["data"] |= {"datasets": [str(dataset)], "workers": 0, "held_out_cameras": 0.4}
    settings["validation"] |= {"views": 1, "batch_size": 1, "batches": 1}
    settings["encoders"] |= {"image": {"image_size": 64, "grid": 8}, "hand": {"packaged_grid": 8}}
    settings["meshes"]["samples"] = 500
    settings["slat_vae"]["network"] |= {"feature_channels": 568, "channels": 12, "blocks": 1}
    settings["slat_vae"]["loss"]["kl"] = 0.0001  # else the first steps mostly shrink the latents
    settings["slat_vae"]["features"] = {
        "views": 4,
        "image_size": 64,
        "supersampling": 1,
        "cache": None if cache is None else str(cache),
    }
    flow = {"channels": 12, "heads": 1, "blocks": 1, "io_channels": [4, 8], "condition_channels": 12}
    settings["slat_flow"]["network"] |= flow
    settings["slat_flow"]["recipe"] |= {"views": [1, 1], "image_size": 32}
    for component, steps in STEPS.items():
        recipe = settings[component]["recipe"]
        recipe["batch_size"] = 1
        recipe["trainer"] |= {"steps": steps, "checkpoint_every": steps, "validate_every": steps}
        recipe["trainer"] |= {"log_every": 1, "precision": "float32"}
        recipe["optimizer"]["warmup_steps"] = 2
    return stage_two(parse_config(yaml.safe_dump(settings), where="small"))


def trained(name: str, config: StageTwoTrainingConfig, folder: Path) -> list[float]:
    """Losses of its steps."""
    events: list[TrainingEvent] = []
    (component,) = (component for component in config.components() if component.name == name)
    train_component(
        component,
        config,
        folder,
        accelerator=Accelerator(cpu=True),
        report=events.append,
    )
    return [event.losses["loss"] for event in events if isinstance(event, StepReport)]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("views")
    write_textured_balls(root / "balls")
    return root


def test_the_vae_learns_and_the_flow_trains_on_it(place: Path) -> None:
    config = small_config(place / "balls", place / "features")
    losses = trained("slat_vae", config, place / "run")
    assert all(map(math.isfinite, losses))
    assert sum(losses[-4:]) < 0.7 * sum(losses[:4])
    assert all(map(math.isfinite, trained("slat_flow", config, place / "run")))
    # Where the features are kept decides nothing: a finished run is found without its cache, and needs no views.
    elsewhere = small_config(place / "balls", None)
    assert trained("slat_vae", elsewhere, place / "run") == []
    task = elsewhere.flow.load(place / "run", torch.device("cpu"))
    occupancy = torch.zeros(1, 64, 64, 64, dtype=torch.bool)
    occupancy[0, 20:24, 20:24, 20:24] = True
    prediction = task.predict(torch.rand(1, 2, 3, 32, 32), occupancy, torch.Generator().manual_seed(0))
    assert torch.isfinite(prediction.decoded.features).all()
