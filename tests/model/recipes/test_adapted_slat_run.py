"""Stage 2 as the paper trains it, small: imported VAE and flow, features of views, adapters; merging and export."""

import shutil
from pathlib import Path

import pytest
import torch
import yaml
from safetensors.torch import load_file, save_file

from model.recipes.slat_components import load_slat_flow
from model.recipes.slat_config import ImportedSlatVae, SlatTrainingConfig, load_any_config
from model.structured_latent.flow import SlatFlow
from model.structured_latent.flow_training import SlatFlowTask
from model.weights.weight_file import write_weight_file
from tests.model.networks.adapters import read_by_peft
from tests.model.small_run import ROOT, fails, forehoi, write_config
from tests.model.structured_latent.object_features.textured_ball import write_textured_balls
from tests.model.weights.published_slat import write_published

CPU = torch.device("cpu")
VAE = {"feature_channels": 568, "channels": 12, "blocks": 1, "heads": 1, "mlp_ratio": 2, "upsample": []}
FLOW = {"channels": 12, "condition_channels": 12, "blocks": 2, "heads": 1, "mlp_ratio": 2, "io_channels": [8]}


def small_paper(root: Path) -> dict:
    """paper_slat.yaml with small networks, the open encoders, and the balls."""
    settings = yaml.safe_load((ROOT / "configs" / "model" / "paper_slat.yaml").read_text())
    settings["data"] |= {"datasets": [str(root / "balls")], "workers": 0, "samples_per_motion": 2}
    settings["data"] |= {"on_corrupt": "raise", "cameras": "train", "held_out_cameras": 0.4}
    settings["validation"] |= {"split": "train", "views": 1, "batch_size": 1, "batches": 1}
    settings["encoders"] |= {"image": {"image_size": 64, "grid": 8}, "hand": {"packaged_grid": 8}}
    settings["meshes"]["samples"] = 500
    settings["slat_vae"]["network"] |= VAE
    settings["slat_vae"]["features"] |= {"views": 3, "image_size": 64, "supersampling": 1}
    settings["slat_vae"] |= {"weights": str(root / "slat.safetensors")}
    settings["slat_vae"]["features"]["cache"] = str(root / "features")
    settings["slat_flow"]["network"] |= FLOW
    settings["slat_flow"] |= {"start": str(root / "slat.safetensors"), "hand_width": 8, "hidden": 16}
    settings["slat_flow"]["lora"] |= {"rank": 2, "alpha": 4}
    settings["slat_flow"]["sampler"]["steps"] = 2
    recipe = settings["slat_flow"]["recipe"]
    recipe |= {"batch_size": 1, "views": [1, 2], "image_size": 32}
    recipe["trainer"] |= {"steps": 3, "checkpoint_every": 1, "validate_every": 3, "log_every": 1}
    recipe["trainer"]["precision"] = "float32"
    return settings


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with data, imported weights, a configuration, and its finished run."""
    root = tmp_path_factory.mktemp("adapted_slat")
    write_textured_balls(root / "balls")
    path = write_config(root / "config.yaml", small_paper(root))
    config = config_of(root)
    # Small values, so that a network of random weights is not chaotic.
    write_published(root / "TRELLIS" / "ckpts", config.slat_flow.network, config.slat_vae.network, std=0.05)
    status, output = forehoi(
        "weights", "import", root / "TRELLIS", "--config", path, "--out", root / "slat.safetensors"
    )
    assert status == 0, output
    assert "every key: " in output
    status, output = forehoi("train", path, "--out", root / "run")
    assert status == 0, output
    return root


def config_of(root: Path) -> SlatTrainingConfig:
    config = load_any_config(root / "config.yaml")
    assert isinstance(config, SlatTrainingConfig)
    return config


def loaded(root: Path, run: Path) -> SlatFlowTask:
    return load_slat_flow(config_of(root), run, CPU)


def test_only_the_flow_is_trained(place: Path) -> None:
    assert isinstance(config_of(place).slat_vae, ImportedSlatVae)
    assert [path.name for path in (place / "run").iterdir()] == ["slat_flow"]
    text = fails("train", "slat_vae", "--config", place / "config.yaml", "--out", place / "run")
    assert "has weights already" in text


def test_vae_frozen_flow_and_normalisation_are_those_of_the_file(place: Path) -> None:
    task, file = loaded(place, place / "run"), load_file(place / "slat.safetensors")
    for group, module in (("encoder", task.vae.encoder), ("surface", task.vae.surface)):
        for name, tensor in module.state_dict().items():
            assert torch.equal(tensor, file[f"slat_vae.{group}.{name}"].float())
    flow = {name.replace(".base_layer", ""): t for name, t in task.network.flow.state_dict().items()}
    of_flow = {
        n.removeprefix("stage_two.flow."): t for n, t in file.items() if n.startswith("stage_two.flow.")
    }
    assert all(torch.equal(flow[name], tensor.float()) for name, tensor in of_flow.items())
    assert torch.equal(task.network.normalisation.std, file["stage_two.normalisation.std"])


def test_features_of_each_object_were_made_once(place: Path) -> None:
    """Two training objects; the flow was trained on both kinds, plain and mirrored, from one file each."""
    files = list((place / "features").rglob("*.safetensors"))
    assert 1 <= len(files) <= 2
    assert all(load_file(path).keys() == {"plain", "mirrored"} for path in files)


def with_large_adapters(run: Path, out: Path) -> Path:
    """The run with adapters that matter: after three steps B is still nearly zero."""
    shutil.copytree(run, out)
    path = out / "slat_flow" / "checkpoints" / "step-00000003" / "average.safetensors"
    tensors, generator = load_file(path), torch.Generator().manual_seed(4)
    for name, tensor in tensors.items():
        if ".lora_B." in name:
            tensors[name] = 0.2 * torch.randn(tensor.shape, generator=generator)
    save_file(tensors, path)
    return out


def latents(task: SlatFlowTask) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(1, 2, 3, 32, 32, generator=generator)
    occupancy = torch.rand(1, 64, 64, 64, generator=generator) < 0.002
    return task.predict(images, occupancy, generator).latent.features


def test_merged_weights_are_the_same_function_without_adapters(place: Path, tmp_path: Path) -> None:
    run, out = with_large_adapters(place / "run", tmp_path / "run"), tmp_path / "merged.safetensors"
    status, output = forehoi("weights", "merge", run, "--out", out)
    assert status == 0, output
    assert f"start: {out}" in output
    before = latents(loaded(place, run))
    assert not torch.allclose(before, latents(loaded(place, place / "run")), atol=1e-3)
    assert not any("lora" in name for name in load_file(out))
    # A new run that starts from the merged file: one step at rate zero, then its weights are the file's.
    settings = yaml.safe_load((place / "config.yaml").read_text())
    settings["slat_flow"] |= {"lora": None, "start": str(out)}
    settings["slat_flow"]["recipe"]["trainer"] |= {"steps": 1, "validate_every": 1}
    settings["slat_flow"]["recipe"]["optimizer"]["learning_rate"] = 0.0
    write_config(tmp_path / "config.yaml", settings)
    status, output = forehoi("train", tmp_path / "config.yaml", "--out", tmp_path / "again")
    assert status == 0, output
    torch.testing.assert_close(latents(loaded(tmp_path, tmp_path / "again")), before, rtol=1e-3, atol=1e-4)


def test_an_exported_adapter_is_that_of_the_averages_and_peft_reads_it(place: Path, tmp_path: Path) -> None:
    status, output = forehoi("weights", "export-adapter", place / "run", "--out", tmp_path / "adapter")
    assert status == 0, output
    plain = read_by_peft(SlatFlow(config_of(place).slat_flow.network), tmp_path / "adapter")
    expected = dict(loaded(place, place / "run").network.flow.named_parameters())
    found = {name: p for name, p in plain.named_parameters() if p.requires_grad}
    assert len(found) == 20
    assert all(torch.equal(parameter, expected[name]) for name, parameter in found.items())


def test_what_does_not_fit_is_one_line(place: Path, tmp_path: Path) -> None:
    config = tmp_path / "config.yaml"
    command = ("train", config, "--out", tmp_path / "run")
    for section, changes, problem in (
        ("network", {"feature_channels": 100}, "is 100, encoders.image gives 568 channels"),
        ("network", {"channels": 24}, "slat_vae.encoder.* do not fit this configuration"),
        (None, {"weights": str(tmp_path / "none")}, "there is no such file"),
        (None, {"features": {}}, "feature_channels is 568: expected 16"),
    ):
        settings = small_paper(place)
        target = settings["slat_vae"] if section is None else settings["slat_vae"][section]
        if problem.startswith("is 100"):  # else the file is refused first
            settings["slat_vae"]["weights"] = str(resized_encoder(place, tmp_path, 100))
        target |= changes
        write_config(config, settings)
        assert problem in fails(*command)
    assert "no checkpoint of stage_one and of slat_flow" in fails(
        "weights", "merge", tmp_path / "run", "--out", tmp_path / "merged.safetensors"
    )


def resized_encoder(place: Path, folder: Path, channels: int) -> Path:
    """The imported weights, for features of another width."""
    tensors = load_file(place / "slat.safetensors")
    name = "slat_vae.encoder.input_layer.weight"
    tensors[name] = tensors[name][:, :channels].contiguous()
    write_weight_file(folder / "resized.safetensors", tensors, sources={})
    return folder / "resized.safetensors"


def test_other_vae_weights_are_noticed(place: Path, tmp_path: Path) -> None:
    """Same shapes, other values, in a file of its own: the run is of another configuration."""
    tensors = load_file(place / "slat.safetensors")
    tensors["slat_vae.surface.out_layer.bias"] += 1
    write_weight_file(tmp_path / "other.safetensors", tensors, sources={})
    settings = small_paper(place)
    settings["slat_vae"]["weights"] = str(tmp_path / "other.safetensors")
    write_config(tmp_path / "config.yaml", settings)
    text = fails("train", tmp_path / "config.yaml", "--out", place / "run")
    assert "was trained with another configuration" in text
