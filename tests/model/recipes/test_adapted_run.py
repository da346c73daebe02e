"""Stage 1 from imported weights with adapters: what is trained, exact resume, merging, export, what does not fit."""

import shutil
from pathlib import Path

import pytest
import torch
import yaml
from safetensors.torch import load_file, save_file

from model.recipes.components import load_stage_one
from model.recipes.config import TrainingConfig, load_config
from model.sparse_structure.geometry_branch import GeometryBranch
from model.sparse_structure.stage_one import StageOneTask
from model.weights.weight_file import write_weight_file
from tests.model.data.balls import write_balls
from tests.model.networks.adapters import read_by_peft
from tests.model.small_run import fails, forehoi, small_settings, write_config
from tests.model.weights.published import write_published

CPU = torch.device("cpu")
VAE = {"patch": 4, "channels": [4, 8], "latent_channels": 8, "residual_blocks": [0, 0], "middle_blocks": 0}
GEOMETRY = {
    "latent_resolution": 8,
    "latent_channels": 8,
    "patch": 1,
    "channels": 24,
    "condition_channels": 16,
    "blocks": 2,
    "heads": 2,
    "mlp_ratio": 2,
    "preconditioned": False,
}
MASKS = {
    "feature_channels": 8,
    "grid": 8,
    "patch": 4,
    "channels": 16,
    "blocks": 1,
    "heads": 2,
    "mlp_ratio": 2,
}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with data, imported weights, a configuration, and its finished run."""
    root = tmp_path_factory.mktemp("adapted")
    write_balls(root / "balls")
    settings = small_settings(root / "balls")
    settings["vae"] = {"network": VAE, "weights": str(root / "trellis.safetensors")}
    settings["stage_one"] |= {
        "start": {"weights": str(root / "trellis.safetensors"), "latent_scale": 1.0},
        "lora": {"rank": 2, "alpha": 4, "dropout": 0.0},
        "network": {"geometry": GEOMETRY, "masks": MASKS, "checkpoint_blocks": False},
        "hand_width": 8,
        "hidden": 16,
    }
    settings["stage_one"]["recipe"]["trainer"]["steps"] = 4
    config = load_config(write_config(root / "config.yaml", settings))
    # Small values, so that a network of random weights is not chaotic.
    write_published(root / "published", config.stage_one.network, config.vae.network, std=0.1)
    arguments = ("--config", root / "config.yaml", "--out", root / "trellis.safetensors")
    status, output = forehoi("weights", "import", root / "published", *arguments)
    assert status == 0, output
    assert "every key: " in output
    status, output = forehoi("train", root / "config.yaml", "--out", root / "run")
    assert status == 0, output
    return root


def checkpoint(run: Path, step: int) -> Path:
    return run / "stage_one" / "checkpoints" / f"step-{step:08d}"


def config_of(place: Path) -> TrainingConfig:
    return load_config(place / "config.yaml")


def trained_names(place: Path) -> set[str]:
    task = load_stage_one(config_of(place), place / "run", CPU)
    return {name for name, parameter in task.module.named_parameters() if parameter.requires_grad}


def test_parts_with_weights_are_not_trained(place):
    assert sorted(path.name for path in (place / "run").iterdir()) == ["hand_encoder", "stage_one"]
    text = fails("train", "vae", "--config", place / "config.yaml", "--out", place / "run")
    assert "has weights already" in text


def test_exactly_the_adapters_and_the_new_modules_are_trained_and_saved(place):
    names = trained_names(place)
    adapters = {
        f"flow.geometry.blocks.{j}.{layer}.lora_{side}.default.weight"
        for j in range(GEOMETRY["blocks"])
        for layer in (
            "self_attn.to_qkv",
            "self_attn.to_out",
            "cross_attn.to_q",
            "cross_attn.to_kv",
            "cross_attn.to_out",
        )
        for side in "AB"
    }
    assert {name for name in names if name.startswith("flow.geometry.")} == adapters
    task = load_stage_one(config_of(place), place / "run", CPU)
    new = {name for name, _ in task.module.named_parameters() if not name.startswith("flow.geometry.")}
    assert names - adapters == new
    assert {name.rsplit(".", maxsplit=name.count(".") - 1)[0] for name in new} == {
        "aggregator.hand_mix",
        "aggregator.hand_smooth",
        "aggregator.mlp",
        "flow.masks",
        "flow.fusion",
        "flow.context",
    }
    saved = checkpoint(place / "run", 4)
    assert load_file(saved / "average.safetensors").keys() == names
    assert load_file(saved / "weights.safetensors").keys() == names | {"flow.geometry.pos_emb"}


def test_frozen_weights_are_those_of_the_file_to_the_bit(place):
    task = load_stage_one(config_of(place), place / "run", CPU)
    state = {name.replace(".base_layer", ""): tensor for name, tensor in task.module.state_dict().items()}
    for name, tensor in load_file(place / "trellis.safetensors").items():
        if name.startswith("flow.geometry."):
            assert torch.equal(state[name], tensor.float())


def test_a_resumed_run_equals_one_in_one_go_bit_for_bit(place, tmp_path):
    shutil.copytree(place / "run", tmp_path / "run")
    shutil.rmtree(checkpoint(tmp_path / "run", 4))
    assert checkpoint(tmp_path / "run", 3).is_dir()
    status, output = forehoi(
        "train", "stage_one", "--config", place / "config.yaml", "--out", tmp_path / "run"
    )
    assert status == 0, output
    for file in ("weights", "average", "optimizer"):
        whole = load_file(checkpoint(place / "run", 4) / f"{file}.safetensors")
        parts = load_file(checkpoint(tmp_path / "run", 4) / f"{file}.safetensors")
        assert whole.keys() == parts.keys()
        assert all(torch.equal(whole[name], parts[name]) for name in whole)


def predicted_masks(task: StageOneTask, images: torch.Tensor) -> torch.Tensor:
    return task.predict(images, torch.Generator().manual_seed(0)).masks


@pytest.fixture(scope="module")
def images() -> torch.Tensor:
    return torch.rand(1, 2, 3, 128, 128, generator=torch.Generator().manual_seed(3))


def with_large_adapters(run: Path, out: Path) -> Path:
    """The run with adapters that matter: after four steps B is still nearly zero."""
    shutil.copytree(run, out)
    path = checkpoint(out, 4) / "average.safetensors"
    tensors = load_file(path)
    generator = torch.Generator().manual_seed(4)
    for name, tensor in tensors.items():
        if ".lora_B." in name:
            tensors[name] = 0.2 * torch.randn(tensor.shape, generator=generator)
    save_file(tensors, path)
    return out


def test_merged_weights_are_the_same_function_without_adapters(place, tmp_path, images):
    run = with_large_adapters(place / "run", tmp_path / "run")
    out = tmp_path / "merged.safetensors"
    status, output = forehoi("weights", "merge", run, "--out", out)
    assert status == 0, output
    assert "latent_scale: 1.0" in output
    before = predicted_masks(load_stage_one(config_of(place), run, CPU), images)
    small = predicted_masks(load_stage_one(config_of(place), place / "run", CPU), images)
    assert not torch.allclose(before, small, atol=1e-3)
    merged = load_file(out)
    assert not any("lora" in name for name in merged)
    # A new run that starts from the merged file: one step at rate zero, then its weights are the file's.
    settings = yaml.safe_load((place / "config.yaml").read_text())
    settings["stage_one"] |= {"lora": None, "start": {"weights": str(out), "latent_scale": 1.0}}
    settings["stage_one"]["recipe"]["trainer"]["steps"] = 1
    settings["stage_one"]["recipe"]["optimizer"]["learning_rate"] = 0.0
    config = write_config(tmp_path / "merged.yaml", settings)
    shutil.copytree(run / "hand_encoder", tmp_path / "again" / "hand_encoder")
    status, output = forehoi("train", "stage_one", "--config", config, "--out", tmp_path / "again")
    assert status == 0, output
    after = predicted_masks(load_stage_one(load_config(config), tmp_path / "again", CPU), images)
    torch.testing.assert_close(after, before, rtol=1e-3, atol=1e-4)


def test_an_exported_adapter_is_that_of_the_averages_and_peft_reads_it(place, tmp_path):
    status, output = forehoi("weights", "export-adapter", place / "run", "--out", tmp_path / "adapter")
    assert status == 0, output
    task = load_stage_one(config_of(place), place / "run", CPU)
    plain = read_by_peft(GeometryBranch(config_of(place).stage_one.network.geometry), tmp_path / "adapter")
    expected = dict(task.network.flow.geometry.named_parameters())
    found = {name: p for name, p in plain.named_parameters() if p.requires_grad}
    assert len(found) == 20
    assert all(torch.equal(parameter, expected[name]) for name, parameter in found.items())


def test_what_does_not_fit_is_one_line(place, tmp_path):
    settings = yaml.safe_load((place / "config.yaml").read_text())
    config = write_config(tmp_path / "other.yaml", settings)
    command = ("train", "stage_one", "--config", config, "--out", tmp_path / "run")
    shutil.copytree(place / "run" / "hand_encoder", tmp_path / "run" / "hand_encoder")
    settings["stage_one"]["network"]["geometry"] = GEOMETRY | {"channels": 32}
    write_config(config, settings)
    assert "flow.geometry.* do not fit this configuration" in fails(*command)
    settings["stage_one"]["network"]["geometry"] = GEOMETRY
    settings["stage_one"]["start"]["weights"] = str(tmp_path / "none.safetensors")
    write_config(config, settings)
    assert "none.safetensors: there is no such file" in fails(*command)
    settings["stage_one"]["start"] = None
    write_config(config, settings)
    assert "lora adapts weights that are there" in fails(*command)
    no_run = fails("weights", "merge", tmp_path / "run", "--out", tmp_path / "merged.safetensors")
    assert "holds no checkpoint of stage_one" in no_run


def test_another_start_file_is_noticed_by_resume_and_by_merge(place, tmp_path):
    """Same path, same shapes, other values."""
    weights = place / "trellis.safetensors"
    original = weights.read_bytes()
    tensors = load_file(weights)
    tensors["flow.geometry.out_layer.bias"] += 1.0
    write_weight_file(weights, tensors, sources={})
    try:
        text = fails("train", "stage_one", "--config", place / "config.yaml", "--out", place / "run")
        assert "was trained with another configuration" in text
        text = fails("weights", "merge", place / "run", "--out", tmp_path / "merged.safetensors")
        assert "started from other weights" in text
    finally:
        weights.write_bytes(original)
