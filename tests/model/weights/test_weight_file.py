"""Our weight files: what a training can start from, and what does not fit."""

from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from model.encoders.aggregator import AggregatorConfig, FeatureAggregator
from model.errors import ModelError
from model.networks.lora import LoraSettings, add_lora
from model.sparse_structure.stage_one import StageOne
from model.sparse_structure.vae import StructureVae
from model.weights.importing import import_networks
from model.weights.trellis import stage_one_networks
from model.weights.weight_file import (
    GEOMETRY,
    VAE,
    StartConfig,
    load_start,
    load_weights,
    weights_sha256,
    write_weight_file,
)
from tests.model.weights.published import DECODER, FLOW, SMALL_FLOW, SMALL_VAE, flow_config, write_published

NARROW_FLOW = flow_config(channels=8, blocks=2, mask_blocks=1, heads=2, resolution=2, grid=2)


def stage_one(seed: int, flow=SMALL_FLOW) -> StageOne:
    torch.manual_seed(seed)
    sizes = AggregatorConfig(
        image_channels=3,
        image_grid=2,
        hand_channels=3,
        hand_grid=2,
        hand_width=8,
        hidden=16,
        channels=flow.masks.feature_channels,
    )
    return StageOne(FeatureAggregator(sizes), flow)


def copied(module: nn.Module) -> dict[str, torch.Tensor]:
    return {name: tensor.clone() for name, tensor in module.state_dict().items()}


def assert_unchanged(module: nn.Module, before: dict[str, torch.Tensor]) -> None:
    assert all(torch.equal(tensor, before[name]) for name, tensor in module.state_dict().items())


@pytest.fixture
def imported(tmp_path: Path) -> tuple[Path, dict[str, dict[str, torch.Tensor]]]:
    written = write_published(tmp_path / "published")
    out = tmp_path / "trellis.safetensors"
    import_networks(tmp_path / "published", stage_one_networks(SMALL_FLOW, SMALL_VAE), out)
    return out, written


def test_published_weights_become_the_geometry_branch_and_nothing_else_changes(imported):
    path, written = imported
    network = stage_one(seed=0)
    before = copied(network)
    load_start(path, network)
    for name, tensor in network.state_dict().items():
        published = written[FLOW].get(name.removeprefix(GEOMETRY)) if name.startswith(GEOMETRY) else None
        assert torch.equal(tensor, before[name] if published is None else published.float())


def test_published_weights_become_the_vae(imported):
    path, written = imported
    vae = StructureVae(SMALL_VAE)
    load_weights(path, vae, group=VAE)
    for name, tensor in vae.decoder.state_dict().items():
        assert tensor.dtype == torch.float32
        assert torch.equal(tensor, written[DECODER][name].float())


def test_a_whole_stage_one_round_trips(tmp_path):
    source, target = stage_one(seed=1), stage_one(seed=2)
    path = tmp_path / "whole.safetensors"
    write_weight_file(path, source.state_dict(), sources={})
    load_start(path, target)
    assert_unchanged(target, copied(source))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["whole.safetensors"]


def test_the_digest_follows_content_and_nothing_else(tmp_path):
    tensors = copied(stage_one(seed=1))
    write_weight_file(tmp_path / "a.safetensors", tensors, sources={"from": "here"})
    write_weight_file(tmp_path / "b.safetensors", dict(reversed(tensors.items())), sources={"from": "there"})
    next(iter(tensors.values())).view(-1)[0] += 1e-6
    write_weight_file(tmp_path / "c.safetensors", tensors, sources={"from": "here"})
    a, b, c = (weights_sha256(tmp_path / f"{name}.safetensors") for name in "abc")
    assert a == b != c


def fails(path: Path, module: Any, *parts: str, group: str | None = None) -> None:
    before = copied(module)
    with pytest.raises(ModelError) as caught:
        load_start(path, module) if group is None else load_weights(path, module, group=group)
    assert "\n" not in str(caught.value)
    assert all(part in str(caught.value) for part in parts), str(caught.value)
    assert_unchanged(module, before)


def test_weights_of_other_sizes_are_one_line_and_change_nothing(imported, tmp_path):
    path, _ = imported
    fails(
        path, stage_one(seed=0, flow=NARROW_FLOW), "flow.geometry.* do not fit", "(8, 16) in the file, (8, 8)"
    )
    adapted = stage_one(seed=0)
    add_lora(adapted.flow.geometry, LoraSettings(rank=2, alpha=4, dropout=0.0))
    fails(path, adapted, "missing (")
    tensors = copied(stage_one(seed=0))
    tensors.pop("aggregator.mlp.0.bias")
    write_weight_file(tmp_path / "part.safetensors", tensors, sources={})
    with pytest.raises(ModelError, match=r"aggregator\.\* do not fit .* 1 missing \(mlp\.0\.bias\)"):
        load_start(tmp_path / "part.safetensors", stage_one(seed=0))
    only_flow = {name: tensor for name, tensor in load_file(path).items() if name.startswith("flow.")}
    write_weight_file(tmp_path / "flow.safetensors", only_flow, sources={})
    fails(tmp_path / "flow.safetensors", StructureVae(SMALL_VAE), "vae.* do not fit", group=VAE)


def test_files_that_are_not_ours(tmp_path):
    network = stage_one(seed=0)
    fails(tmp_path / "none.safetensors", network, "there is no such file", "forehoi weights import")
    foreign = tmp_path / "foreign.safetensors"
    save_file(network.state_dict(), foreign)
    fails(foreign, network, "is a safetensors file of another kind")
    foreign.write_bytes(foreign.read_bytes()[:-10])
    fails(foreign, network, "is no complete safetensors file")
    with pytest.raises(ModelError, match="latent_scale"):
        StartConfig(weights=foreign, latent_scale=0.0)
