"""Low-rank adaptation of attention projections, through peft (section 4.1: r = 64, alpha = 128, dropout 0).

Adapters are written in peft's own format: `peft.PeftModel.from_pretrained(branch, folder)` reads them.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from peft import LoraConfig, get_peft_model_state_dict
from peft.mapping import inject_adapter_in_model
from peft.tuners.lora import LoraLayer
from safetensors.torch import save_file
from torch import nn

from model.errors import ModelError
from shards.settings import Range

__all__ = [
    "ATTENTION_PROJECTIONS",
    "LoraSettings",
    "add_lora",
    "export_adapter",
    "merge_lora",
]

ATTENTION_PROJECTIONS = ("to_qkv", "to_q", "to_kv", "to_out")
"""Every projection of a self- or cross-attention; the paper adapts "qkv and output projections"."""

_WEIGHTS_FILE, _PEFT_PREFIX = "adapter_model.safetensors", "base_model.model."


@dataclass(frozen=True, kw_only=True)
class LoraSettings:
    """W + alpha / rank B A. The paper: rank 64, alpha 128, dropout 0."""

    rank: Annotated[int, Range(1, 65_536)]
    alpha: Annotated[int, Range(1, 65_536)]
    dropout: Annotated[float, Range(0, 1)] = 0.0

    def __post_init__(self) -> None:
        if self.rank < 1 or self.alpha <= 0 or not 0 <= self.dropout < 1:
            raise ModelError(
                "lora", str(self), expected="rank >= 1, alpha > 0, 0 <= dropout < 1", action="Use 64, 128, 0."
            )


def add_lora(branch: nn.Module, settings: LoraSettings) -> None:
    """Adapt the attention projections of `branch` in place and freeze everything else inside it.

    Adapters start with B = 0, so the function is unchanged. Parameters outside `branch` are left alone:
    for stage 1 give `flow.geometry`, so that the mask branch trains whole.
    """
    config = LoraConfig(
        r=settings.rank,
        lora_alpha=settings.alpha,
        lora_dropout=settings.dropout,
        bias="none",
        target_modules=list(ATTENTION_PROJECTIONS),
    )
    inject_adapter_in_model(config, branch)


def merge_lora(branch: nn.Module) -> None:
    """Add the adapters into the weights and remove them; parameter names are then those before `add_lora`.

    Every parameter of the branch is trainable afterwards. ModelError when there is no adapter.
    """
    adapted = [(name, layer) for name, layer in branch.named_modules() if isinstance(layer, LoraLayer)]
    if not adapted:
        raise ModelError(
            "lora", "no adapter to merge", expected="a branch with adapters", action="Call add_lora first."
        )
    for name, layer in adapted:
        layer.merge(safe_merge=True)
        branch.set_submodule(name, layer.get_base_layer())
    del branch.peft_config
    branch.requires_grad_(True)


def export_adapter(branch: nn.Module, folder: Path) -> None:
    """Write the adapter of `branch` (settings and weights only) into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    # The config carries names only; peft would else record the path of a base model, and there is none.
    branch.peft_config["default"].save_pretrained(str(folder))  # type: ignore[index, union-attr]
    state = get_peft_model_state_dict(branch)
    weights = {_PEFT_PREFIX + name: tensor.detach().contiguous().cpu() for name, tensor in state.items()}
    save_file(weights, str(folder / _WEIGHTS_FILE), metadata={"format": "pt"})
