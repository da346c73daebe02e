"""Adapters out of a run: merged into the weights that they adapt, or in peft's own format."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from model.config import TrainingConfig, parse_config
from model.errors import ModelError
from model.networks.lora import LoraSettings, add_lora, export_adapter, merge_lora
from model.sparse_structure.dual_branch import DualBranchFlow
from model.sparse_structure.geometry_branch import GeometryBranch
from model.training.checkpoint import latest_checkpoint, read_state
from model.training.identity import part_sha256
from model.weights.safetensors_file import read_header, read_tensors
from model.weights.weight_file import GEOMETRY, StartConfig, load_weights, write_weight_file

__all__ = ["export_run_adapter", "merge_run"]


@dataclass(frozen=True, kw_only=True)
class _AdaptedRun:
    """The newest checkpoint of a run of stage 1 with adapters."""

    checkpoint: Path
    config: TrainingConfig
    lora: LoraSettings
    start: StartConfig
    tensors: dict[str, Tensor]  # averaged; buffers and everything trained, names of StageOne


def merge_run(run: Path, out: Path) -> StartConfig:
    """Write the averaged weights of a run with its adapters merged, as a weight file; and how to start from it.

    ModelError when the run has no adapters, or when the file that it started from is gone or another one.
    """
    adapted = _open(run)
    with torch.device("meta"):
        flow = DualBranchFlow(adapted.config.stage_one.network)
    flow.to_empty(device="cpu")
    load_weights(adapted.start.weights, flow.geometry, group=GEOMETRY)
    add_lora(flow.geometry, adapted.lora)
    of_flow = {n.removeprefix("flow."): t for n, t in adapted.tensors.items() if n.startswith("flow.")}
    left = flow.load_state_dict(of_flow, strict=False)
    trained = {name for name, parameter in flow.named_parameters() if parameter.requires_grad}
    if left.unexpected_keys or (absent := trained.intersection(left.missing_keys)):
        raise _unfit(adapted, sorted([*left.unexpected_keys, *absent])[0])
    merge_lora(flow.geometry)
    rest = {name: tensor for name, tensor in adapted.tensors.items() if not name.startswith("flow.")}
    merged = {f"flow.{name}": tensor for name, tensor in flow.state_dict().items()} | rest
    sources = {"checkpoint": str(adapted.checkpoint), "start": str(adapted.start.weights)}
    write_weight_file(out, merged, sources=sources)
    return StartConfig(weights=out, latent_scale=adapted.start.latent_scale)


def export_run_adapter(run: Path, folder: Path) -> int:
    """Write the averaged adapter of a run of stage 1 into `folder`, as peft does; the number of its parameters."""
    adapted = _open(run)
    with torch.device("meta"):
        branch = GeometryBranch(adapted.config.stage_one.network.geometry)
        add_lora(branch, adapted.lora)
    expected = {name for name, parameter in branch.named_parameters() if parameter.requires_grad}
    held = {
        name.removeprefix(GEOMETRY): t for name, t in adapted.tensors.items() if name.startswith(GEOMETRY)
    }
    if absent := sorted(expected - held.keys()):
        raise _unfit(adapted, absent[0])
    adapter = {name: held[name] for name in sorted(expected)}
    branch.load_state_dict(adapter, strict=False, assign=True)
    export_adapter(branch, folder)
    return sum(tensor.numel() for tensor in adapter.values())


def _open(run: Path) -> _AdaptedRun:
    path = latest_checkpoint(run / "stage_one" / "checkpoints")
    if path is None:
        raise ModelError(
            run,
            "holds no checkpoint of stage_one",
            expected="the folder of a training run",
            action="Check the path.",
        )
    state = read_state(path)
    config = parse_config(state.config_yaml, where=f"{path / 'state.json'}: config_yaml")
    lora, start = config.stage_one.lora, config.stage_one.start
    if lora is None or start is None:
        raise ModelError(
            path,
            "was trained without adapters",
            expected="a run with stage_one.lora",
            action="All its weights are in weights.safetensors and average.safetensors.",
        )
    if part_sha256("stage_one", config) != state.config_sha256:
        raise ModelError(
            path,
            f"started from other weights than those that are in {start.weights} now",
            expected="the file that the run started from",
            action="Put it back.",
        )
    return _AdaptedRun(
        checkpoint=path,
        config=config,
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


def _unfit(adapted: _AdaptedRun, first: str) -> ModelError:
    return ModelError(
        adapted.checkpoint,
        f"does not fit its own configuration, first {first}",
        expected="the adapters and new modules of stage 1",
        action="Use the version of this package that wrote it.",
    )
