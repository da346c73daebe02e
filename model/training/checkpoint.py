"""Checkpoints: safetensors and JSON in a folder that exists whole or not at all.

RUN/checkpoints/step-00001200/weights.safetensors    trained parameters and buffers
                              average.safetensors    their moving average: what inference uses
                              optimizer.safetensors  "<parameter>/<quantity>"
                              state.json             step, data position, configuration, machine
"""

import json
import os
import re
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from torch import nn

from model.errors import ModelError
from model.training.ema import MovingAverage
from model.training.precision import Machine

__all__ = [
    "TrainingState",
    "delete_partial",
    "latest_checkpoint",
    "load_average",
    "load_checkpoint",
    "read_state",
    "require_data",
    "save_checkpoint",
]

FORMAT_VERSION = 3
_NAME = re.compile(r"step-(\d{8})")
_PARTIAL = re.compile(r"\.step-\d{8}\.partial")


@dataclass(frozen=True, kw_only=True)
class TrainingState:
    """Where a run stands, apart from tensors. Randomness is a function of the step (`step_generators.py`)."""

    step: int
    epoch: int
    samples_consumed: int  # of the epoch, over all ranks
    config_yaml: str
    config_sha256: str
    data_sha256: str  # of what is read, wherever it lies
    machine: Machine  # that the last step ran on
    format_version: int = FORMAT_VERSION


def save_checkpoint(
    folder: Path,
    state: TrainingState,
    module: nn.Module,
    average: MovingAverage,
    optimizer: torch.optim.Optimizer,
    *,
    keep: int,
) -> Path:
    """Write one checkpoint in one step, then delete all but the newest `keep`."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"step-{state.step:08d}"
    partial = folder / f".{path.name}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    save_file(_trained(module), partial / "weights.safetensors")
    save_file({k: v.contiguous() for k, v in average.averages.items()}, partial / "average.safetensors")
    save_file(_optimizer_tensors(module, optimizer), partial / "optimizer.safetensors")
    (partial / "state.json").write_text(json.dumps(asdict(state), indent=2), encoding="utf-8")
    for file in partial.iterdir():
        with file.open("rb") as handle:
            os.fsync(handle.fileno())
    if path.exists():  # the same step, saved again after a resume
        shutil.rmtree(path)
    os.replace(partial, path)
    for old in _checkpoints(folder)[:-keep]:
        shutil.rmtree(old)
    return path


def delete_partial(folder: Path) -> None:
    """Delete what killed processes left half-written. Nobody else may be training there."""
    for path in folder.iterdir() if folder.is_dir() else ():
        if _PARTIAL.fullmatch(path.name):
            shutil.rmtree(path)


def latest_checkpoint(folder: Path) -> Path | None:
    """The newest complete checkpoint, or None."""
    found = _checkpoints(folder)
    return found[-1] if found else None


def load_checkpoint(
    path: Path,
    module: nn.Module,
    average: MovingAverage,
    optimizer: torch.optim.Optimizer,
    *,
    config_sha256: str,
    data_sha256: str,
) -> TrainingState:
    """Restore everything, bit-exactly. ModelError when it is of another configuration, of other data, or damaged."""
    state = read_state(path)
    if state.config_sha256 != config_sha256:
        raise ModelError(
            path,
            f"was trained with another configuration ({state.config_sha256[:12]})",
            expected=f"configuration {config_sha256[:12]}",
            action="Continue with the configuration in its state.json, or train into another folder.",
        )
    require_data(path, state, data_sha256)
    weights = _tensors(path / "weights.safetensors")
    _require_same(path / "weights.safetensors", set(weights), set(_trained(module)))
    module.load_state_dict(weights, strict=False)
    averages = _tensors(path / "average.safetensors")
    _require_same(path / "average.safetensors", set(averages), set(average.averages))
    for name, value in averages.items():
        average.averages[name].copy_(value)
    _restore_optimizer(path, module, optimizer)
    return state


def load_average(path: Path, module: nn.Module) -> TrainingState:
    """Put the averaged weights of a checkpoint into `module`, for inference."""
    weights, averages = _tensors(path / "weights.safetensors"), _tensors(path / "average.safetensors")
    _require_same(path / "weights.safetensors", set(weights), set(_trained(module)))
    module.load_state_dict(weights | averages, strict=False)
    return read_state(path)


def require_data(path: Path, state: TrainingState, data_sha256: str) -> None:
    """ModelError when a checkpoint was trained on other data."""
    if state.data_sha256 != data_sha256:
        raise ModelError(
            path,
            f"was trained on other data ({state.data_sha256[:12]})",
            expected=f"the data that the configuration names now ({data_sha256[:12]})",
            action="Name the same shards in the same order, wherever they lie, or train into another folder (--out).",
        )


def read_state(path: Path) -> TrainingState:
    """state.json of a checkpoint. ModelError when it is missing, damaged or of another version."""
    try:
        content = json.loads((path / "state.json").read_text(encoding="utf-8"))
        version = content["format_version"]
        state = None
        if version == FORMAT_VERSION:
            state = TrainingState(**content | {"machine": Machine(**content["machine"])})
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise ModelError(
            path,
            f"is no checkpoint ({error})",
            expected="a folder step-<number> with state.json and three safetensors files",
            action="Name a checkpoint folder, or delete a damaged one to continue from the one before.",
        ) from error
    if state is None:
        raise ModelError(
            path,
            f"has checkpoint format {version}",
            expected=f"format {FORMAT_VERSION}",
            action="Use the version of this package that wrote it.",
        )
    return state


def _checkpoints(folder: Path) -> list[Path]:
    return sorted(p for p in folder.glob("step-*") if _NAME.fullmatch(p.name)) if folder.is_dir() else []


def _trained(module: nn.Module) -> dict[str, torch.Tensor]:
    """Trainable parameters and the buffers that are saved; frozen encoders stay out of checkpoints."""
    frozen = {name for name, parameter in module.named_parameters() if not parameter.requires_grad}
    state = module.state_dict()
    return {name: value.detach().contiguous() for name, value in state.items() if name not in frozen}


def _optimizer_tensors(module: nn.Module, optimizer: torch.optim.Optimizer) -> dict[str, torch.Tensor]:
    name_of = {parameter: name for name, parameter in module.named_parameters()}
    tensors = {}
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            for quantity, value in optimizer.state.get(parameter, {}).items():
                tensors[f"{name_of[parameter]}/{quantity}"] = torch.as_tensor(value).detach().contiguous()
    return tensors


def _restore_optimizer(path: Path, module: nn.Module, optimizer: torch.optim.Optimizer) -> None:
    tensors = _tensors(path / "optimizer.safetensors")
    by_name = dict(module.named_parameters())
    trained = {name for name, parameter in by_name.items() if parameter.requires_grad}
    held = {key.rpartition("/")[0] for key in tensors}
    if not held <= trained:
        _require_same(path / "optimizer.safetensors", held, trained)
    state: dict[torch.Tensor, dict[str, torch.Tensor]] = {}
    for key, value in tensors.items():
        name, _, quantity = key.rpartition("/")
        parameter = by_name[name]
        # Adam keeps its step count on the CPU, everything else beside the parameter.
        place = value if quantity == "step" else value.to(parameter.device)
        state.setdefault(parameter, {})[quantity] = place
    optimizer.state.clear()
    optimizer.state.update(state)


def _tensors(path: Path) -> dict[str, torch.Tensor]:
    try:
        return load_file(path)
    except Exception as error:  # safetensors raises its own Rust error type, or OSError
        raise ModelError(
            path,
            f"cannot be read ({error})",
            expected="a complete safetensors file",
            action="Delete this checkpoint; training continues from the one before.",
        ) from error


def _require_same(path: Path, found: set[str], expected: set[str]) -> None:
    if found == expected:
        return
    missing, extra = sorted(expected - found), sorted(found - expected)
    raise ModelError(
        path,
        f"lacks {missing[:3]} ({len(missing)}) and has {extra[:3]} ({len(extra)}) besides",
        expected=f"the {len(expected)} parameters of this network",
        action="Use the configuration that the checkpoint was trained with.",
    )
