"""Adapters out of a run of either stage: merged into the weights that they adapt, or in peft's own format."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor, nn

from model.errors import ModelError
from model.networks.lora import LoraSettings, add_lora, export_adapter, merge_lora
from model.recipes.component_identity import part_sha256
from model.recipes.config import StageOnePart, TrainingConfig
from model.recipes.slat_components import slat_part_sha256
from model.recipes.slat_config import SlatFlowPart, SlatTrainingConfig, parse_any_config
from model.sparse_structure.dual_branch import DualBranchFlow
from model.structured_latent.flow import SlatFlow
from model.tensor_files.safetensors_file import read_header, read_tensors
from model.training.checkpoint import latest_checkpoint, read_state
from model.weights.slat import STAGE_TWO
from model.weights.weight_file import StartConfig, load_weights, write_weight_file

__all__ = ["export_run_adapter", "merge_run"]

_STAGE_ONE, _SLAT_FLOW = "stage_one", "slat_flow"
_FLOW = "flow."  # of the flow's tensors in checkpoints of both stages


@dataclass(frozen=True, kw_only=True, eq=False)
class _Stage:
    """What the stages differ in."""

    part: StageOnePart | SlatFlowPart
    sha256: Callable[[], str]  # of the part and the files that it stands on, as they are now
    flow: nn.Module  # without weights
    branch: str  # what of it is adapted: a submodule, "" for all of it
    file_prefix: str  # of the names of checkpoints, in weight files

    @property
    def branch_prefix(self) -> str:
        """Of the adapted tensors, in checkpoints."""
        return f"{_FLOW}{self.branch}." if self.branch else _FLOW


@dataclass(frozen=True, kw_only=True, eq=False)
class _AdaptedRun:
    """The newest checkpoint of a run with adapters."""

    checkpoint: Path
    stage: _Stage
    lora: LoraSettings
    start: StartConfig | Path  # as the configuration has it
    weights: Path  # of `start`
    tensors: dict[str, Tensor]  # averaged; buffers and everything trained, names of the checkpoint


def merge_run(run: Path, out: Path) -> StartConfig | Path:
    """Write the averaged weights of a run with its adapters merged, as a weight file; and the `start` that names it.

    ModelError when the run has no adapters, or when the file that it started from is gone or another one.
    """
    adapted = _open(run)
    stage, flow = adapted.stage, adapted.stage.flow.to_empty(device="cpu")
    branch = flow.get_submodule(stage.branch)
    load_weights(adapted.weights, branch, group=stage.file_prefix + stage.branch_prefix)
    add_lora(branch, adapted.lora)
    of_flow = {n.removeprefix(_FLOW): t for n, t in adapted.tensors.items() if n.startswith(_FLOW)}
    left = flow.load_state_dict(of_flow, strict=False)
    trained = {name for name, parameter in flow.named_parameters() if parameter.requires_grad}
    if left.unexpected_keys or (absent := trained.intersection(left.missing_keys)):
        raise _unfit(adapted, sorted([*left.unexpected_keys, *absent])[0])
    merge_lora(branch)
    rest = {name: tensor for name, tensor in adapted.tensors.items() if not name.startswith(_FLOW)}
    merged = {_FLOW + name: tensor for name, tensor in flow.state_dict().items()} | rest
    sources = {"checkpoint": str(adapted.checkpoint), "start": str(adapted.weights)}
    write_weight_file(out, {stage.file_prefix + n: t for n, t in merged.items()}, sources=sources)
    if isinstance(adapted.start, StartConfig):
        return StartConfig(weights=out, latent_scale=adapted.start.latent_scale)
    return out


def export_run_adapter(run: Path, folder: Path) -> int:
    """Write the averaged adapter of a run into `folder`, as peft does; the number of its parameters."""
    adapted = _open(run)
    branch, prefix = adapted.stage.flow.get_submodule(adapted.stage.branch), adapted.stage.branch_prefix
    with torch.device("meta"):
        add_lora(branch, adapted.lora)
    expected = {name for name, parameter in branch.named_parameters() if parameter.requires_grad}
    held = {n.removeprefix(prefix): t for n, t in adapted.tensors.items() if n.startswith(prefix)}
    if absent := sorted(expected - held.keys()):
        raise _unfit(adapted, absent[0])
    adapter = {name: held[name] for name in sorted(expected)}
    branch.load_state_dict(adapter, strict=False, assign=True)
    export_adapter(branch, folder)
    return sum(tensor.numel() for tensor in adapter.values())


def _open(run: Path) -> _AdaptedRun:
    found = {part: latest_checkpoint(run / part / "checkpoints") for part in (_STAGE_ONE, _SLAT_FLOW)}
    checkpoints = {part: path for part, path in found.items() if path is not None}
    if len(checkpoints) != 1:
        raise ModelError(
            run,
            f"holds {'no' if not checkpoints else 'a'} checkpoint of {' and of '.join(found)}",
            expected="the folder of a training run of one stage",
            action="Check the path.",
        )
    ((part, path),) = checkpoints.items()
    state = read_state(path)
    stage = _stage(parse_any_config(state.config_yaml, where=f"{path / 'state.json'}: config_yaml"))
    lora, start = stage.part.lora, stage.part.start
    if lora is None or start is None:
        raise ModelError(
            path,
            "was trained without adapters",
            expected=f"a run with {part}.lora",
            action="All its weights are in weights.safetensors and average.safetensors.",
        )
    weights = start.weights if isinstance(start, StartConfig) else start
    if stage.sha256() != state.config_sha256:
        raise ModelError(
            path,
            f"started from other weights than those that are in {weights} now",
            expected="the file that the run started from",
            action="Put it back.",
        )
    return _AdaptedRun(
        checkpoint=path,
        stage=stage,
        lora=lora,
        start=start,
        weights=weights,
        tensors=_averaged(path),
    )


def _stage(config: TrainingConfig | SlatTrainingConfig) -> _Stage:
    with torch.device("meta"):
        if isinstance(config, TrainingConfig):
            return _Stage(
                part=config.stage_one,
                sha256=partial(part_sha256, _STAGE_ONE, config),
                flow=DualBranchFlow(config.stage_one.network),
                branch="geometry",
                file_prefix="",
            )
        return _Stage(
            part=config.slat_flow,
            sha256=partial(slat_part_sha256, _SLAT_FLOW, config),
            flow=SlatFlow(config.slat_flow.network),
            branch="",
            file_prefix=STAGE_TWO,
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
        expected="the adapters and new modules of its stage",
        action="Use the version of this package that wrote it.",
    )
