"""SamplingConfig: the settings of a scene, assembled from those of its concerns."""

from dataclasses import dataclass
from typing import Literal

from datagen.sampling.appearance import AppearanceConfig
from datagen.sampling.cameras import CamerasConfig
from datagen.sampling.clip import ClipConfig
from datagen.sampling.lights import LightsConfig
from datagen.sampling.tables import TableConfig

__all__ = ["RenderConfig", "SamplingConfig"]


@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """Cycles settings that change pixels."""

    samples: int
    max_bounces: int
    denoise: bool
    exposure_ev: tuple[float, float]  # (lowest, highest) of a uniform draw
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
