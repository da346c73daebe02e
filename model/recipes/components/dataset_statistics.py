"""What stage 1 must know of its training data when it is used: kept with the run, so that nobody needs the data."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from model.errors import ModelError
from model.tensor_files.safetensors_file import write_tensors
from model.training.checkpoint import latest_checkpoint

__all__ = ["DatasetStatistics", "load_statistics", "statistics_of_run"]

_FILE = "dataset_statistics.safetensors"


@dataclass(frozen=True, kw_only=True, eq=False)
class DatasetStatistics:
    """Measured once, before the first step."""

    latent_scale: float  # latents are divided by it
    mean_shape: Bool[Tensor, "64 64 64"]  # of the training objects


def statistics_of_run(folder: Path, measure: Callable[[], DatasetStatistics]) -> DatasetStatistics:
    """Those of a run that resumes, or of one that begins: measured and written.

    They belong to the first checkpoint, which is of one configuration and of one content of the data. Before there is
    one, what a stopped run left may be of others, and measuring also draws from torch's global generator, as in a run
    that was never stopped.
    """
    if latest_checkpoint(folder / "checkpoints") is not None and (folder / _FILE).exists():
        return load_statistics(folder)
    statistics = measure()
    scale = torch.tensor(statistics.latent_scale, dtype=torch.float64)
    # Every rank measures, and writes, the same.
    write_tensors(folder / _FILE, {"latent_scale": scale, "mean_shape": statistics.mean_shape})
    return statistics


def load_statistics(folder: Path) -> DatasetStatistics:
    """ModelError when they are missing or broken."""
    path = folder / _FILE
    try:
        tensors = load_file(path)
        return DatasetStatistics(
            latent_scale=float(tensors["latent_scale"]), mean_shape=tensors["mean_shape"].bool()
        )
    except (OSError, SafetensorError, KeyError) as error:
        raise ModelError(
            path,
            f"cannot be read ({' '.join(str(error).split())[:120]})",
            expected="what a training of stage_one writes before its first step",
            action=f"Train it first: forehoi train {folder.name}.",
        ) from error
