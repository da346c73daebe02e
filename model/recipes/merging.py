"""Adapters out of a run of either stage: merged into the weights that they adapt, or in peft's own format."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from model.errors import ModelError
from model.networks.lora import LoraSettings, add_lora, export_adapter, merge_lora
from model.recipes.components.slat_flow_component import SlatFlowComponent
from model.recipes.components.stage_one_component import StageOneComponent
from model.recipes.config import parse_config
from model.tensor_files.safetensors_file import read_header, read_tensors
from model.training.checkpoint import latest_checkpoint, read_state
from model.weights.weight_file import load_weights, write_weight_file

__all__ = ["export_run_adapter", "merge_run"]

_FLOW = "flow."  # of the flow's tensors in checkpoints of both stages


@dataclass(frozen=True, kw_only=True, eq=False)
class _AdaptedRun:
    """The newest checkpoint of a run with adapters."""

    checkpoint: Path
    component: StageOneComponent | SlatFlowComponent
    flow: nn.Module  # on the meta device
    lora: LoraSettings
    start: Path  # the weights that it adapts
    tensors: dict[str, Tensor]  # averaged; buffers and everything trained, names of the checkpoint

    @property
    def branch_prefix(self) -> str:
        """Of the adapted tensors, in checkpoints."""
        branch = self.component.adapted_branch
        return f"{_FLOW}{branch}." if branch else _FLOW


def merge_run(run: Path, out: Path) -> str:
    """Write the averaged weights of a run with its adapters merged, as a weight file; and the `start` that names it.

    ModelError when the run has no adapters, or when the file that it started from is gone or another one.
    """
    adapted = _open(run)
    flow, file_prefix = adapted.flow.to_empty(device="cpu"), adapted.component.file_prefix
    branch = flow.get_submodule(adapted.component.adapted_branch)
    load_weights(adapted.start, branch, group=file_prefix + adapted.branch_prefix)
    add_lora(branch, adapted.lora)
    of_flow = {n.removeprefix(_FLOW): t for n, t in adapted.tensors.items() if n.startswith(_FLOW)}
    left = flow.load_state_dict(of_flow, strict=False)
    trained = {name for name, parameter in flow.named_parameters() if parameter.requires_grad}
    _require_fit(adapted, {*left.unexpected_keys, *trained.intersection(left.missing_keys)})
    merge_lora(branch)
    rest = {name: tensor for name, tensor in adapted.tensors.items() if not name.startswith(_FLOW)}
    merged = {_FLOW + name: tensor for name, tensor in flow.state_dict().items()} | rest
    sources = {"checkpoint": str(adapted.checkpoint), "start": str(adapted.start)}
    write_weight_file(out, {file_prefix + n: t for n, t in merged.items()}, sources=sources)
    return adapted.component.start_text(out)


def export_run_adapter(run: Path, folder: Path) -> int:
    """Write the averaged adapter of a run into `folder`, as peft does; the number of its parameters."""
    adapted = _open(run)
    branch, prefix = adapted.flow.get_submodule(adapted.component.adapted_branch), adapted.branch_prefix
    with torch.device("meta"):
        add_lora(branch, adapted.lora)
    expected = {name for name, parameter in branch.named_parameters() if parameter.requires_grad}
    held = {n.removeprefix(prefix): t for n, t in adapted.tensors.items() if n.startswith(prefix)}
    _require_fit(adapted, expected - held.keys())
    adapter = {name: held[name] for name in sorted(expected)}
    branch.load_state_dict(adapter, strict=False, assign=True)
    export_adapter(branch, folder)
    return sum(tensor.numel() for tensor in adapter.values())


def _open(run: Path) -> _AdaptedRun:
    names = (StageOneComponent.name, SlatFlowComponent.name)
    found = [path for name in names if (path := latest_checkpoint(run / name / "checkpoints")) is not None]
    if len(found) != 1:
        raise ModelError(
            run,
            f"holds {'no' if not found else 'a'} checkpoint of {' and of '.join(names)}",
            expected="the folder of a training run of one stage",
            action="Check the path.",
        )
    (path,) = found
    state = read_state(path)
    component = parse_config(state.config_yaml, where=f"{path / 'state.json'}: config_yaml").flow
    lora, start = component.section.lora, component.start_weights
    if lora is None or start is None:
        raise ModelError(
            path,
            "was trained without adapters",
            expected=f"a run with {component.name}.lora",
            action="All its weights are in weights.safetensors and average.safetensors.",
        )
    if component.sha256() != state.config_sha256:
        raise ModelError(
            path,
            f"started from other weights than those that are in {start} now",
            expected="the file that the run started from",
            action="Put it back.",
        )
    with torch.device("meta"):
        flow = component.flow()
    return _AdaptedRun(
        checkpoint=path,
        component=component,
        flow=flow,
        lora=lora,
        start=start,
        tensors=_averaged(path),
    )


def _averaged(checkpoint: Path) -> dict[str, Tensor]:
    tensors: dict[str, Tensor] = {}
    for name in ("weights.safetensors", "average.safetensors"):
        path = checkpoint / name
        shapes = read_header(
            path, expected="a complete checkpoint", action="Delete a damaged checkpoint."
        ).shapes
        tensors |= read_tensors(path, {key: key for key in shapes})
    return tensors


def _require_fit(adapted: _AdaptedRun, misfits: set[str]) -> None:
    """ModelError when there are tensors that the flow and the checkpoint do not both have."""
    if misfits:
        raise ModelError(
            adapted.checkpoint,
            f"does not fit its own configuration, first {min(misfits)}",
            expected="the adapters and new modules of its stage",
            action="Use the version of this package that wrote it.",
        )
