"""Lamps and environment, balanced so that every combination is well exposed.

Levels are in units of a white card: the radiance of a white diffuse card that faces the light. An
environment of mean radiance 1 (as the renderer normalises them) and strength s gives a card the
level s on average; a small lamp of P watts at distance d, facing it, gives P / (pi d)^2.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float

from datagen.scene.scene import AreaLight, Background
from shards.settings import Range

__all__ = ["LightsConfig", "blackbody_rgb", "lamp_power_w", "sample_light"]

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
SRGB_FROM_XYZ = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])


@dataclass(frozen=True, kw_only=True)
class LightsConfig:
    """Light of a motion. Pairs are (lowest, highest) of a uniform draw."""

    # white card facing the key lamp, environment included
    card_level: Annotated[tuple[float, float], Range(0, 1000, rising=True)]
    # of that level; the key lamp has the rest
    hdri_share: Annotated[tuple[float, float], Range(0, 1, rising=True)]
    # name or path of an EXR -> factor on its share (a night stays dark)
    hdris: Annotated[dict[str, float], Range(0, 1000)]
    n_lamps: Annotated[tuple[int, int], Range(1, 4, rising=True)]  # 1..4: key, fill, rim and one more
    fill_ratio: Annotated[tuple[float, float], Range(0, 100, rising=True)]  # of the key's level
    rim_ratio: Annotated[tuple[float, float], Range(0, 100, rising=True)]
    elevation_deg: Annotated[tuple[float, float], Range(-90, 90, rising=True)]
    distance_m: Annotated[tuple[float, float], Range(0.001, 100, rising=True)]
    size_m: Annotated[tuple[float, float], Range(0.001, 100, rising=True)]  # side of the square
    temperature_k: Annotated[tuple[float, float], Range(800, 40_000, rising=True)]

    def __post_init__(self) -> None:
        if not 1 <= self.n_lamps[0] <= self.n_lamps[1] <= 4:
            raise ValueError(f"n_lamps is {self.n_lamps}: expected 1 <= lowest <= highest <= 4")
        if not self.hdris:
            raise ValueError("hdris is empty: expected at least one environment, such as studio: 1.0")


def sample_light(
    config: LightsConfig,
    center_world: Float[np.ndarray, "3"],
    lamps_rng: np.random.Generator,
    background_rng: np.random.Generator,
) -> tuple[tuple[AreaLight, ...], Background]:
    """Lamps about `center_world` and the environment that makes up the rest of the level."""
    level = background_rng.uniform(*config.card_level)
    hdri = sorted(config.hdris)[background_rng.integers(len(config.hdris))]
    share = min(1.0, background_rng.uniform(*config.hdri_share) * config.hdris[hdri])
    background = Background(
        hdri=hdri, rotation_rad=float(background_rng.uniform(0.0, 2.0 * np.pi)), strength=float(level * share)
    )
    key_level = level * (1.0 - share)
    key_azimuth = lamps_rng.uniform(0.0, 2.0 * np.pi)
    temperature = lamps_rng.uniform(*config.temperature_k)
    places = [
        (1.0, 0.0),
        (
            lamps_rng.uniform(*config.fill_ratio),
            np.pi * lamps_rng.uniform(0.4, 0.9) * lamps_rng.choice([-1.0, 1.0]),
        ),
        (lamps_rng.uniform(*config.rim_ratio), np.pi + lamps_rng.normal() * 0.4),
        (lamps_rng.uniform(*config.fill_ratio), lamps_rng.uniform(0.0, 2.0 * np.pi)),
    ]
    n_lamps = int(lamps_rng.integers(config.n_lamps[0], config.n_lamps[1] + 1))
    lamps = tuple(
        _lamp(config, center_world, key_level * ratio, key_azimuth + azimuth, temperature, lamps_rng)
        for ratio, azimuth in places[:n_lamps]
    )
    return lamps, background


def _lamp(
    config: LightsConfig,
    center_world: Float[np.ndarray, "3"],
    level: float,
    azimuth_rad: float,
    temperature_k: float,
    rng: np.random.Generator,
) -> AreaLight:
    elevation = np.radians(rng.uniform(*config.elevation_deg))
    distance = rng.uniform(*config.distance_m)
    direction = np.array(
        [np.cos(elevation) * np.cos(azimuth_rad), np.cos(elevation) * np.sin(azimuth_rad), np.sin(elevation)]
    )
    red, green, blue = blackbody_rgb(float(np.clip(temperature_k * rng.uniform(0.85, 1.2), 1700.0, 12000.0)))
    return AreaLight(
        position_world=center_world + distance * direction,
        target_world=center_world + rng.normal(size=3) * 0.03,
        power_w=lamp_power_w(level, distance),
        size_m=float(rng.uniform(*config.size_m)),
        color_rgb=(red, green, blue),
    )


def lamp_power_w(level: float, distance_m: float) -> float:
    """Watts of a lamp that lights a white card at `distance_m` to radiance `level`.

    A diffuse emitter of P watts sends P / pi per steradian ahead, so the card receives
    P / (pi d^2) and shines with 1 / pi of it. Checked against Cycles (within 1 %).
    """
    return float(level * (np.pi * distance_m) ** 2)


def blackbody_rgb(temperature_k: float) -> tuple[float, float, float]:
    """Linear sRGB of a black body, luminance 1, no negative parts. Range 1667..25000 K.

    Chromaticity: cubic fits of the Planckian locus (Kim et al., US patent 7024034).
    """
    if not 1667.0 <= temperature_k <= 25000.0:
        raise ValueError(f"colour temperature {temperature_k} K: expected 1667..25000")
    t = 1000.0 / temperature_k
    if temperature_k <= 4000.0:
        x = -0.2661239 * t**3 - 0.2343589 * t**2 + 0.8776956 * t + 0.179910
    else:
        x = -3.0258469 * t**3 + 2.1070379 * t**2 + 0.2226347 * t + 0.240390
    if temperature_k <= 2222.0:
        y = -1.1063814 * x**3 - 1.34811020 * x**2 + 2.18555832 * x - 0.20219683
    elif temperature_k <= 4000.0:
        y = -0.9549476 * x**3 - 1.37418593 * x**2 + 2.09137015 * x - 0.16748867
    else:
        y = 3.0817580 * x**3 - 5.87338670 * x**2 + 3.75112997 * x - 0.37001483
    rgb = np.maximum(SRGB_FROM_XYZ @ np.array([x / y, 1.0, (1.0 - x - y) / y]), 0.0)
    red, green, blue = (rgb / (LUMINANCE @ rgb)).tolist()
    return red, green, blue
