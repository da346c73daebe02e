"""Both stages with sizes cut down, trained for some steps by the real trainer on a dataset of balls."""

from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file

from model.inference.networks import open_stage_one
from model.recipes.config import read_settings
from model.training.checkpoint import latest_checkpoint
from tests.model.small_run import forehoi, small_settings, write_config

FILLED = 0.004  # of the cube, once `fill_some` has been called
_LAST_BIAS = "decoder.out_layer.2.bias"


def small_stage_one(dataset: Path) -> dict[str, Any]:
    """The content of a configuration of stage 1."""
    config = small_settings(dataset)
    config["hand_encoder"] = None
    config["encoders"]["hand"] = {"packaged_grid": 8}
    return config


def small_stage_two(dataset: Path) -> dict[str, Any]:
    """The content of a configuration of stage 2."""
    config = read_settings("tiny_slat").data
    config["data"] |= small_settings(dataset)["data"]
    config["validation"] |= {"views": 1, "batch_size": 1, "batches": 1}
    config["encoders"] |= {"image": {"image_size": 64, "grid": 8}, "hand": {"packaged_grid": 8}}
    config["meshes"]["samples"] = 500
    config["slat_vae"]["network"] |= {"channels": 16, "blocks": 1}
    flow = {"channels": 24, "condition_channels": 24, "blocks": 1, "heads": 1, "io_channels": [8, 16]}
    config["slat_flow"]["network"] |= flow
    config["slat_flow"]["sampler"]["steps"] = 2
    for component in ("slat_vae", "slat_flow"):
        recipe = config[component]["recipe"]
        recipe |= {"batch_size": 1} if component == "slat_vae" else {"batch_size": 1, "views": [1, 1]}
        recipe["trainer"] |= {"steps": 2, "checkpoint_every": 2, "validate_every": 2, "log_every": 1}
        recipe["trainer"]["precision"] = "float32"
    return config


def train_small(folder: Path, settings: dict[str, Any]) -> Path:
    """The run of all components of a configuration."""
    status, output = forehoi("train", write_config(folder.with_suffix(".yaml"), settings), "--out", folder)
    assert status == 0, output
    return folder


def fill_some(run: Path) -> None:
    """Two steps leave a decoder that fills nothing or all: moves its last bias until noise fills FILLED of the cube."""
    task = open_stage_one(run).config.flow.load(run, torch.device("cpu"))
    shape = task.network.flow.config.geometry.latent_shape
    noise = torch.randn(1, *shape, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        logits = task.vae.decoder(noise * task.config.latent_scale)
    change_last_bias(run, -float(logits.flatten().quantile(1 - FILLED)))


def change_last_bias(run: Path, change: float) -> None:
    """Adds to every logit of the VAE of a run."""
    path = latest_checkpoint(run / "vae" / "checkpoints")
    assert path is not None
    for name in ("weights.safetensors", "average.safetensors"):
        tensors = load_file(path / name)
        tensors[_LAST_BIAS] = tensors[_LAST_BIAS] + change
        save_file(tensors, path / name)
