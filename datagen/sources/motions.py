"""From the `motions` section of a configuration to the motions that can be drawn."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from datagen.grasps.recorded.graspxl import SequenceFile, find_sequences
from datagen.grasps.recorded.replay import ReplayConfig
from datagen.input_error import InputError

__all__ = ["MotionsConfig", "graspxl_root", "recorded_sequences"]


@dataclass(frozen=True, kw_only=True)
class MotionsConfig:
    """Where the motions come from."""

    source: Literal["simulated", "graspxl"]
    graspxl_root: Path | None  # folder of mano_dataset_1 and object_dataset; null: $GRASPXL
    sizes: tuple[str, ...]  # of small, medium, large: GraspXL's scales of each object
    replay: ReplayConfig


def graspxl_root(path: Path | None) -> Path:
    """The GraspXL folder: `path`, else $GRASPXL. InputError when neither is given."""
    if path is not None:
        return path.expanduser()
    value = os.environ.get("GRASPXL", "")
    if not value:
        raise InputError(
            "motions.graspxl_root",
            "is null and GRASPXL is not set",
            expected="the folder that holds GraspXL's mano_dataset_1 and object_dataset",
            action="Set one of them (make render GRASPXL=...); `datagen assets` tells how to get the data.",
        )
    return Path(value).expanduser()


def recorded_sequences(config: MotionsConfig) -> Mapping[str, SequenceFile]:
    """Every recorded sequence by its id, in natural order; empty when motions are simulated."""
    if config.source == "simulated":
        return {}
    found = find_sequences(graspxl_root(config.graspxl_root), config.sizes)
    return {file.sequence_id: file for file in found}
