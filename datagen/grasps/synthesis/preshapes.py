"""Hand openings from which a grasp closes, found by random search over natural postures."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.grasps.hand_body import HandBody, bone_transforms
from shards.joints import DIGITS, Digit

__all__ = ["PreshapeLibrary", "build_preshapes", "closing_rates"]

SAMPLES = 20000
KEPT_PER_APERTURE = 30
APERTURE_STEP_M = 0.01
# How much each finger's pad counts in the opposition to the thumb.
FINGER_SHARE: dict[Digit, float] = {"index": 0.35, "middle": 0.4, "ring": 0.25, "pinky": 0.0}


@dataclass(frozen=True, kw_only=True)
class PreshapeLibrary:
    """Postures whose thumb pad faces the finger pads; all in the hand frame (origin: wrist joint)."""

    angles_rad: Float[np.ndarray, "shape hinge"]
    curl: Float[np.ndarray, " shape"]  # 0: fingers close from the knuckles, 1: they curl
    aperture_m: Float[np.ndarray, " shape"]  # thumb pad to finger pads
    quality: Float[np.ndarray, " shape"]  # opposition, at most 1
    middle: Float[np.ndarray, "shape 3"]  # point halfway between the pads
    across: Float[np.ndarray, "shape 3"]  # unit, thumb pad to finger pads
    reach: Float[np.ndarray, "shape 3"]  # unit, from the palm to `middle`, normal to `across`

    def near(self, aperture_m: float) -> Int[np.ndarray, " choice"]:
        """Rows whose aperture is within one step; empty when the hand cannot open so."""
        return np.flatnonzero(np.abs(self.aperture_m - aperture_m) < APERTURE_STEP_M)


def build_preshapes(body: HandBody) -> PreshapeLibrary:
    """The library of one hand. Deterministic: a fixed seed of its own; about 0.3 s."""
    rng = np.random.default_rng(0)
    angles, curl = _sample_postures(body, rng)
    rotation, origin = bone_transforms(body, angles)
    at, facing = {}, {}
    for digit, pad in zip(DIGITS, body.pads):
        at[digit] = origin[:, pad.bone] + rotation[:, pad.bone] @ pad.position_bone
        facing[digit] = rotation[:, pad.bone] @ pad.normal_bone
    fingers = sum(share * at[digit] for digit, share in FINGER_SHARE.items())
    finger_facing = sum(share * facing[digit] for digit, share in FINGER_SHARE.items())
    finger_facing /= np.linalg.norm(finger_facing, axis=1, keepdims=True)
    across = fingers - at["thumb"]
    aperture = np.linalg.norm(across, axis=1)
    across /= aperture[:, None]
    # Pads that look at each other along the line that joins them, finger pads level.
    opposed = 0.3 * _dot(facing["thumb"], across) - 0.3 * _dot(finger_facing, across)
    opposed -= 0.4 * _dot(facing["thumb"], finger_facing)
    level = np.stack([_dot(at[d] - fingers, across) for d in ("index", "middle", "ring")]).std(0)
    middle = 0.5 * (fingers + at["thumb"])
    palm = 0.5 * body.joints_rest[[1, 4, 10, 7]].mean(0) + 0.5 * body.joints_rest[0]
    palm = palm - body.joints_rest[0] - 0.015 * body.dorsal
    reach = middle - palm
    reach -= _dot(reach, across)[:, None] * across
    quality = opposed - 15.0 * level - 0.3 * _strain(body, angles)
    keep = _best_per_aperture(aperture, quality, np.linalg.norm(reach, axis=1) > 0.01)
    return PreshapeLibrary(
        angles_rad=angles[keep],
        curl=curl[keep],
        aperture_m=aperture[keep],
        quality=quality[keep],
        middle=middle[keep],
        across=across[keep],
        reach=(reach / np.linalg.norm(reach, axis=1, keepdims=True))[keep],
    )


def closing_rates(body: HandBody, curl: float) -> Float[np.ndarray, " hinge"]:
    """Relative speed of every hinge while the hand closes; fingertips stay flat for curl 0."""
    rate = np.zeros(len(body.hinges))
    for k, hinge in enumerate(body.hinges):
        if hinge.role == "flexion":
            joint = hinge.name.split("_")[1]
            bend = {"mcp": 1.0, "pip": 0.25 + 0.95 * curl, "dip": 0.05 + 0.6 * curl}
            thumb = {"cmc": 0.9, "mcp": 0.55, "ip": 0.15 + 0.3 * curl}
            rate[k] = (thumb if hinge.digit == "thumb" else bend)[joint]
    return rate


def _sample_postures(
    body: HandBody, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "sample hinge"], Float[np.ndarray, " sample"]]:
    """Fingers flex together with a slight cascade; the thumb is free within its limits."""
    knuckle, curl = rng.uniform(-5.0, 75.0, SAMPLES), rng.uniform(0.0, 1.0, SAMPLES)
    bend = rng.uniform(4.0, 60.0, SAMPLES)
    cascade, spread = rng.uniform(-4.0, 8.0, SAMPLES), rng.uniform(-2.0, 6.0, SAMPLES)
    angles = np.zeros((SAMPLES, len(body.hinges)))
    order = {"index": 0.0, "middle": 0.33, "ring": 0.67, "pinky": 1.0}
    across = np.cross(body.dorsal, body.distal)
    for k, hinge in enumerate(body.hinges):
        if hinge.digit == "thumb":
            inner = 0.05 * (hinge.high_rad - hinge.low_rad)
            angles[:, k] = rng.uniform(hinge.low_rad + inner, hinge.high_rad - 4 * inner, SAMPLES)
            continue
        late = order[hinge.digit]
        joint = hinge.name.split("_")[1]
        if joint == "spread":
            # Fan out from the middle finger: turning about `dorsal` carries `distal` to `across`.
            away = np.sign(across @ (body.joints_rest[hinge.bone] - body.joints_rest[4]))
            degrees = away * spread
        elif joint == "mcp":
            degrees = knuckle + late * cascade
        else:
            degrees = (bend + late * cascade) * (1.0 if joint == "pip" else 0.5)
        angles[:, k] = np.clip(np.deg2rad(degrees), hinge.low_rad, hinge.high_rad)
    return angles, curl


def _strain(body: HandBody, angles: Float[np.ndarray, "sample hinge"]) -> Float[np.ndarray, " sample"]:
    """0 for a thumb in the middle of its ranges, 1 at all its limits."""
    thumb = [k for k, hinge in enumerate(body.hinges) if hinge.digit == "thumb"]
    low = np.array([body.hinges[k].low_rad for k in thumb])
    high = np.array([body.hinges[k].high_rad for k in thumb])
    return (((angles[:, thumb] - (low + high) / 2) / ((high - low) / 2)) ** 2).mean(1)


def _best_per_aperture(
    aperture: Float[np.ndarray, " sample"],
    quality: Float[np.ndarray, " sample"],
    allowed: Bool[np.ndarray, " sample"],
) -> Int[np.ndarray, " kept"]:
    kept = []
    for low in np.arange(0.01, 0.14, APERTURE_STEP_M):
        rows = np.flatnonzero(allowed & (aperture >= low) & (aperture < low + APERTURE_STEP_M))
        kept.append(rows[np.argsort(-quality[rows], kind="stable")[:KEPT_PER_APERTURE]])
    return np.concatenate(kept)


def _dot(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    return np.einsum("ni,ni->n", a, b)
