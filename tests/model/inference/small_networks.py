"""Both stages with sizes cut down, trained for some steps by the real trainer on a dataset of balls."""

from pathlib import Path
from typing import Any

import torch
import yaml
from safetensors.torch import load_file, save_file

from model.training.checkpoint import latest_checkpoint
from tests.model.small_run import ROOT, forehoi, small_settings, write_config

TINY_SLAT = ROOT / "configs" / "model" / "tiny_slat.yaml"
VAE_STEPS = 40  # a shape that is neither empty nor full


def small_stage_one(dataset: Path) -> dict[str, Any]:
    """The content of a configuration of stage 1."""
    config = small_settings(dataset)
    config["vae"]["recipe"]["trainer"] |= {"steps": VAE_STEPS, "validate_every": VAE_STEPS}
    return config


def small_stage_two(dataset: Path) -> dict[str, Any]:
    """The content of a configuration of stage 2."""
    config = yaml.safe_load(TINY_SLAT.read_text())
    config["data"] |= small_settings(dataset)["data"]
    config["validation"] |= {"views": 1, "batch_size": 1, "batches": 1}
    config["encoders"] |= {"image": {"image_size": 64, "grid": 8}, "hand": {"packaged_grid": 8}}
    config["meshes"]["samples"] = 500
    config["slat_vae"]["network"] |= {"channels": 16, "blocks": 1}
    flow = {"channels": 24, "condition_channels": 24, "blocks": 1, "heads": 1, "io_channels": [8, 16]}
    config["slat_flow"]["network"] |= flow
    config["slat_flow"]["sampler"]["steps"] = 2
    for part in ("slat_vae", "slat_flow"):
        recipe = config[part]["recipe"]
        recipe |= {"batch_size": 1, "views": [1, 1]}
        recipe["trainer"] |= {"steps": 2, "checkpoint_every": 2, "validate_every": 2, "log_every": 1}
    return config


def train_small(folder: Path, name: str, settings: dict[str, Any]) -> Path:
    """The run of all parts, in folder/name."""
    config = write_config(folder / f"{name}.yaml", settings)
    status, output = forehoi("train", config, "--out", folder / name)
    assert status == 0, output
    return folder / name


def empty_decoder(run: Path) -> None:
    """Makes the VAE of a run decode everything to nothing: its last bias is far below zero."""
    path = latest_checkpoint(run / "vae" / "checkpoints")
    assert path is not None
    for name in ("weights.safetensors", "average.safetensors"):
        tensors = load_file(path / name)
        tensors["decoder.out_layer.2.bias"] = torch.full_like(tensors["decoder.out_layer.2.bias"], -1e4)
        save_file(tensors, path / name)
