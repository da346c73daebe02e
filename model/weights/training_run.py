"""Output folders of TRELLIS's own trainer: config.json, and checkpoints of torch.save in ckpts/.

denoiser_step0100000.pt                 weights of the network that config.json calls "denoiser"
denoiser_ema0.9999_step0100000.pt       their moving average, which TRELLIS samples with
misc_step0100000.pt                     optimiser and data order
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from model.errors import ModelError
from model.weights.json_file import read_json_object

__all__ = [
    "RunCheckpoint",
    "check_is_weights",
    "chosen_checkpoints",
    "has_config",
    "latent_normalisation",
    "network_description",
    "run_checkpoint",
]

_NAME = re.compile(r"(?P<network>[A-Za-z]\w*?)(?:_ema(?P<rate>[0-9.]+))?_step(?P<step>\d+)")
_STATE = "misc"


@dataclass(frozen=True, kw_only=True)
class RunCheckpoint:
    """What the name of a checkpoint says."""

    path: Path
    network: str  # as config.json calls it: denoiser, encoder, decoder
    ema_rate: str  # empty: the weights themselves
    step: int

    @property
    def is_state(self) -> bool:
        """Whether it holds the optimiser instead of weights."""
        return self.network == _STATE


def run_checkpoint(path: Path) -> RunCheckpoint | None:
    """None for a file that TRELLIS's trainer does not name like this."""
    match = _NAME.fullmatch(path.stem)
    if match is None:
        return None
    return RunCheckpoint(
        path=path, network=match["network"], ema_rate=match["rate"] or "", step=int(match["step"])
    )


def chosen_checkpoints(source: Path, runs: Sequence[RunCheckpoint]) -> list[RunCheckpoint]:
    """The checkpoints of a run's folder where there is one of each network. ModelError when there are more, or none."""
    weights = [checkpoint for checkpoint in runs if not checkpoint.is_state]
    networks = {checkpoint.network for checkpoint in weights}
    if weights and len(networks) == len(weights):
        return weights
    problem, action = "without weights", "Give the folder with its denoiser_step*.pt, or a published release."
    if weights:
        names = ", ".join(checkpoint.path.name for checkpoint in weights[:4])
        problem = f"with {len(weights)} checkpoints ({names}{', ...' if len(weights) > 4 else ''})"
        # What TRELLIS samples with: the last step, averaged where there is an average.
        best = max(weights, key=lambda checkpoint: (checkpoint.step, checkpoint.ema_rate))
        action = f"Give one of them as a file, for example {best.path}."
    raise ModelError(
        source,
        f"is the output of a training of TRELLIS {problem}",
        expected="one checkpoint of each network, or the published files",
        action=action,
    )


def has_config(path: Path) -> bool:
    """Whether the config.json of the run that a checkpoint is of was found."""
    return bool(_run_config(path))


def network_description(path: Path) -> dict[str, object]:
    """Class name and arguments of the network of a checkpoint, from its run's config.json; empty without one."""
    checkpoint, config = run_checkpoint(path), _run_config(path)
    if checkpoint is None:
        return {}
    return _object(_object(config, "models"), checkpoint.network)


def latent_normalisation(path: Path) -> Mapping[str, object] | None:
    """Mean and deviation that the run of a checkpoint divided its latents by; None where it says none."""
    arguments = _object(_object(_run_config(path), "dataset"), "args")
    return _object(arguments, "normalization") or None


def check_is_weights(path: Path) -> None:
    """ModelError for the state of an optimiser."""
    checkpoint = run_checkpoint(path)
    if checkpoint is not None and checkpoint.is_state:
        raise ModelError(
            path,
            "holds the optimiser's state of a training, no weights",
            expected="weights of a training, for example denoiser_ema0.9999_step0100000.pt",
            action="Give the checkpoint of the network that lies beside it.",
        )


def _run_config(path: Path) -> dict[str, object]:
    if run_checkpoint(path) is None:
        return {}
    places = [folder / "config.json" for folder in path.absolute().parents[:2]]
    place = next((place for place in places if place.is_file()), None)
    return read_json_object(place, expected="the configuration of a training of TRELLIS") if place else {}


def _object(container: Mapping[str, object], key: str) -> dict[str, object]:
    value = container.get(key)
    return value if isinstance(value, dict) else {}
