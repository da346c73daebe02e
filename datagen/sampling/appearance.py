"""Hand shape, skin, forearm and sleeve: drawn from plausible ranges."""

import colorsys
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float

from datagen.hands.arm import ArmStyle
from datagen.hands.skin import (
    SkinBasis,
    decode_skin,
    open_nail_mask_png,
    sample_skin_coefficients,
)
from datagen.scene.scene import HandLook
from shards.settings import Range
from shards.storage.png import encode_png

__all__ = ["AppearanceConfig", "sample_arm_style", "sample_betas", "sample_look"]

OPEN_SKIN = "open"  # SkinBasis.name; its nails are known, those of another UV layout are not
MAX_BETA = 2.0  # in standard deviations: beyond it shapes are caricatures


@dataclass(frozen=True, kw_only=True)
class AppearanceConfig:
    """Looks of a hand. Pairs are (lowest, highest) of a uniform draw."""

    n_betas: Annotated[int, Range(0, 10)]
    betas_std: Annotated[float, Range(0, 10)]
    skin_roughness: Annotated[tuple[float, float], Range(0, 1, rising=True)]
    subsurface: Annotated[tuple[float, float], Range(0, 1, rising=True)]
    bump: Annotated[tuple[float, float], Range(0, 1, rising=True)]
    nail_gloss: Annotated[tuple[float, float], Range(0, 1, rising=True)]
    # at most what the grasps were simulated with
    forearm_length_m: Annotated[tuple[float, float], Range(0.05, 0.6, rising=True)]
    forearm_girth: Annotated[tuple[float, float], Range(0.1, 10, rising=True)]
    sleeve_probability: Annotated[float, Range(0, 1)]
    sleeve_start_m: Annotated[tuple[float, float], Range(0, 1, rising=True)]  # from the wrist
    sleeve_weave: Annotated[tuple[float, float], Range(0, 100, rising=True)]


def sample_betas(rng: np.random.Generator, config: AppearanceConfig) -> Float[np.ndarray, " beta"]:
    """Shape coefficients of the hand model: normal, cut off at two standard deviations."""
    return config.betas_std * np.clip(rng.normal(size=config.n_betas), -MAX_BETA, MAX_BETA)


def sample_arm_style(rng: np.random.Generator, config: AppearanceConfig) -> ArmStyle:
    """Forearm, and perhaps a sleeve, for one motion."""
    length = rng.uniform(*config.forearm_length_m)
    has_sleeve = rng.uniform() < config.sleeve_probability
    start = min(rng.uniform(*config.sleeve_start_m), 0.6 * length)
    return ArmStyle(
        length_m=float(length),
        girth=float(rng.uniform(*config.forearm_girth)),
        sleeve_start_m=float(start) if has_sleeve else None,
        sleeve_gap_m=float(rng.uniform(0.003, 0.009)),
        cuff_m=float(rng.uniform(0.015, 0.06)),
        fold_depth_m=float(rng.uniform(0.001, 0.004)),
        fold_phase_rad=float(rng.uniform(0.0, 2.0 * np.pi)),
    )


def sample_look(
    skins: SkinBasis,
    config: AppearanceConfig,
    skin_rng: np.random.Generator,
    sleeve_rng: np.random.Generator,
) -> HandLook:
    """Skin and cloth of one motion."""
    coefficients = sample_skin_coefficients(skin_rng, skins)
    return HandLook(
        skin_png=encode_png(decode_skin(skins, coefficients), level=1),
        skin_coefficients=coefficients,
        skin_roughness=float(skin_rng.uniform(*config.skin_roughness)),
        subsurface=float(skin_rng.uniform(*config.subsurface)),
        bump=float(skin_rng.uniform(*config.bump)),
        nail_gloss=float(skin_rng.uniform(*config.nail_gloss)),
        sleeve_color_rgb=_sleeve_color(sleeve_rng),
        sleeve_weave=float(sleeve_rng.uniform(*config.sleeve_weave)),
        nail_mask_png=open_nail_mask_png() if skins.name == OPEN_SKIN else None,
    )


def _sleeve_color(rng: np.random.Generator) -> tuple[float, float, float]:
    """Linear colour of cloth: half of all clothes are black, white, grey or blue."""
    if rng.uniform() < 0.5:
        hue, saturation = rng.normal(0.61, 0.02), rng.choice([0.05, 0.55]) * rng.uniform(0.5, 1.5)
    else:
        hue, saturation = rng.uniform(), rng.uniform(0.2, 0.8)
    value = float(np.exp(rng.uniform(np.log(0.02), np.log(0.7))))
    return colorsys.hsv_to_rgb(hue % 1.0, float(np.clip(saturation, 0.0, 0.85)), value)
