"""Adapters on a flow of either stage: those of the paper, those that are there, and those that peft reads."""

from pathlib import Path

from peft import PeftModel
from torch import nn


def paper_adapters() -> dict[str, tuple[int, ...]]:
    """Names and shapes of all trainable parameters on a flow of TRELLIS-image-large: 24 blocks of 1024 channels.

    Rank 64 on every projection of every attention.
    """
    shapes = {
        "self_attn.to_qkv": (3072, 1024),
        "self_attn.to_out": (1024, 1024),
        "cross_attn.to_q": (1024, 1024),
        "cross_attn.to_kv": (2048, 1024),
        "cross_attn.to_out": (1024, 1024),
    }
    expected = {}
    for j in range(24):
        for layer, (rows, columns) in shapes.items():
            expected[f"blocks.{j}.{layer}.lora_A.default.weight"] = (64, columns)
            expected[f"blocks.{j}.{layer}.lora_B.default.weight"] = (rows, 64)
    return expected


def trainable_parameters(module: nn.Module) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the parameters that an optimizer would change."""
    return {name: tuple(p.shape) for name, p in module.named_parameters() if p.requires_grad}


def read_by_peft(branch: nn.Module, folder: Path) -> nn.Module:
    """A branch without adapters, with those of an exported folder: trainable, as peft itself reads them."""
    return PeftModel.from_pretrained(branch, str(folder), is_trainable=True).base_model.model
