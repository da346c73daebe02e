"""LoRA: exactly the paper's parameters, no change at the start, merge, and what peft reads."""

from pathlib import Path

import pytest
import torch

from model.errors import ModelError
from model.networks.lora import LoraSettings, add_lora, export_adapter, merge_lora
from model.sparse_structure.geometry_branch import GeometryBranch, GeometryBranchConfig
from tests.model.networks.adapters import paper_adapters, read_by_peft, trainable_parameters

PAPER_LORA = LoraSettings(rank=64, alpha=128, dropout=0.0)
SMALL_LORA = LoraSettings(rank=3, alpha=6, dropout=0.0)

PAPER = GeometryBranchConfig(
    latent_resolution=16,
    latent_channels=8,
    patch=1,
    channels=1024,
    condition_channels=1024,
    blocks=24,
    heads=16,
    mlp_ratio=4,
    preconditioned=False,
)
SMALL = GeometryBranchConfig(
    latent_resolution=2,
    latent_channels=8,
    patch=1,
    channels=12,
    condition_channels=10,
    blocks=2,
    heads=2,
    mlp_ratio=2,
    preconditioned=False,
)


def _branch() -> GeometryBranch:
    torch.manual_seed(0)
    branch = GeometryBranch(SMALL)
    with torch.no_grad():
        for parameter in branch.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    return branch


def _adapted(seed: int = 1) -> GeometryBranch:
    branch = _branch()
    add_lora(branch, SMALL_LORA)
    torch.manual_seed(seed)
    with torch.no_grad():
        for parameter in branch.parameters():
            if parameter.requires_grad:
                parameter.normal_(std=0.3)
    return branch


def _output(branch: GeometryBranch) -> torch.Tensor:
    generator = torch.Generator().manual_seed(2)
    x_t = torch.randn(2, 8, 2, 2, 2, generator=generator)
    contexts = torch.randn(2, 3, 5, 10, generator=generator)
    y, t = branch.embed(x_t), branch.t_embedder(torch.tensor([0.2, 0.9]))
    for block in branch.blocks:
        y = block(y, t, contexts, torch.full((2, 3), 1 / 3))
    return branch.read_out(y, x_t, torch.tensor([0.2, 0.9])).detach()


def test_paper_config_trains_exactly_these_parameters() -> None:
    with torch.device("meta"):
        branch = GeometryBranch(PAPER)
        add_lora(branch, PAPER_LORA)
    assert trainable_parameters(branch) == paper_adapters()
    assert sum(p.numel() for p in branch.parameters() if p.requires_grad) == 20_447_232


def test_adapters_start_without_effect() -> None:
    branch = _branch()
    before = _output(branch)
    add_lora(branch, SMALL_LORA)
    assert torch.equal(_output(branch), before)


def test_merge_keeps_the_function_and_restores_the_names() -> None:
    adapted, names = _adapted(), set(_branch().state_dict())
    before = _output(adapted)
    assert not torch.allclose(before, _output(_branch()))
    merge_lora(adapted)
    torch.testing.assert_close(_output(adapted), before, atol=1e-5, rtol=1e-4)
    assert set(adapted.state_dict()) == names
    assert trainable_parameters(adapted).keys() == trainable_parameters(_branch()).keys()
    with pytest.raises(ModelError, match="no adapter"):
        merge_lora(adapted)


def test_merged_weight_is_w_plus_alpha_over_rank_b_a() -> None:
    adapted = _adapted()
    layer = adapted.blocks[1].cross_attn.to_kv
    expected = layer.base_layer.weight + 2.0 * layer.lora_B["default"].weight @ layer.lora_A["default"].weight
    merge_lora(adapted)
    torch.testing.assert_close(adapted.blocks[1].cross_attn.to_kv.weight, expected)


def test_peft_reads_an_exported_adapter(tmp_path: Path) -> None:
    adapted = _adapted()
    export_adapter(adapted, tmp_path / "adapter")
    files = {path.name for path in (tmp_path / "adapter").iterdir()}
    assert files == {"adapter_config.json", "adapter_model.safetensors"}
    theirs = read_by_peft(_branch(), tmp_path / "adapter")
    assert torch.equal(_output(theirs), _output(adapted))
    assert trainable_parameters(theirs) == trainable_parameters(adapted)


def test_settings_without_meaning_are_refused() -> None:
    with pytest.raises(ModelError, match="rank >= 1"):
        LoraSettings(rank=0, alpha=1, dropout=0.0)
