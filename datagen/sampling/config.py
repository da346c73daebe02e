"""SamplingConfig: the settings of a scene, assembled from those of its concerns."""

from dataclasses import dataclass
from typing import Annotated, Literal

from datagen.sampling.appearance import AppearanceConfig
from datagen.sampling.cameras import CamerasConfig
from datagen.sampling.clip import ClipConfig
from datagen.sampling.lights import LightsConfig
from datagen.sampling.tables import TableConfig
from shards.settings import Range

__all__ = ["RenderConfig", "SamplingConfig"]


@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """Cycles settings that change pixels."""

    samples: Annotated[int, Range(1, 65_536)]
    max_bounces: Annotated[int, Range(0, 1024)]
    denoise: bool
    # (lowest, highest) of a uniform draw
    exposure_ev: Annotated[tuple[float, float], Range(-32, 32, rising=True)]
    view_transform: Literal["AgX", "Filmic", "Standard"]


@dataclass(frozen=True, kw_only=True)
class SamplingConfig:
    """Everything that is drawn at random between a grasp sequence and its images."""

    clip: ClipConfig
    cameras: CamerasConfig
    lights: LightsConfig
    table: TableConfig
    appearance: AppearanceConfig
    render: RenderConfig
