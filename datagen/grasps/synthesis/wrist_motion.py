"""Smooth wrist paths: approach, lift, and turns that show other sides of the object."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from datagen.grasps.config import GraspConfig
from datagen.grasps.hand_body import HandBody
from datagen.grasps.synthesis.physics_world import WristTarget

__all__ = ["WristPath", "minimum_jerk", "plan_turns", "straight", "turn_about"]

# Share of the configured angle that each natural wrist and arm motion gets, about the
# forearm (pronation), the knuckle line (flexion) and the vertical (the arm swings).
TURN_SHARE = (1.0, 0.5, 0.8)
SHIFT_M = (0.05, 0.05, 0.03)  # either way
RAISE_M = 0.12  # more height where the table would be in the way
TURN_TRIES = 40
PATH_CHECKS = 5


@dataclass(frozen=True, kw_only=True)
class WristPath:
    """Wrist poses at the simulation's time steps."""

    positions_world: Float[np.ndarray, "step 3"]
    R_world_from_hand: Float[np.ndarray, "step 3 3"]


def minimum_jerk(steps: int) -> Float[np.ndarray, " step"]:
    """0..1 with zero velocity and acceleration at both ends; the last value is 1."""
    s = np.arange(1, steps + 1) / steps
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def straight(start: WristTarget, shift_world: Float[np.ndarray, "3"], steps: int) -> WristPath:
    """Translate without turning."""
    s = minimum_jerk(steps)
    return WristPath(
        positions_world=start.position_world + s[:, None] * shift_world,
        R_world_from_hand=np.repeat(start.R_world_from_hand[None], steps, 0),
    )


def turn_about(
    start: WristTarget,
    pivot_world: Float[np.ndarray, "3"],
    rotvec: Float[np.ndarray, "3"],
    shift_world: Float[np.ndarray, "3"],
    steps: int,
) -> WristPath:
    """Turn hand and object together about a pivot while shifting the pivot."""
    s = minimum_jerk(steps)
    turns = Rotation.from_rotvec(s[:, None] * rotvec).as_matrix()
    arm = start.position_world - pivot_world
    return WristPath(
        positions_world=pivot_world + s[:, None] * shift_world + turns @ arm,
        R_world_from_hand=turns @ start.R_world_from_hand,
    )


def plan_turns(
    body: HandBody,
    start: WristTarget,
    pivot_world: Float[np.ndarray, "3"],
    carried_world: Float[np.ndarray, "point 3"],
    config: GraspConfig,
    timestep_s: float,
    rng: np.random.Generator,
) -> list[WristPath]:
    """Random turns whose carried points (hand, forearm ends, object) stay above the table.

    Each turn goes to a new orientation relative to the first, so that errors do not add up.
    """
    axes = np.stack([body.distal, np.cross(body.dorsal, body.distal), body.dorsal], 1)
    axes = start.R_world_from_hand @ axes
    axes[:, 2] = [0.0, 0.0, 1.0]
    local = carried_world - pivot_world
    paths: list[WristPath] = []
    at, pivot, turned = start, pivot_world, Rotation.identity()
    for _ in range(int(rng.integers(config.turns[0], config.turns[1] + 1))):
        for attempt in range(TURN_TRIES):
            angle = rng.uniform(*config.turn_angle_rad)
            direction = rng.normal(size=3)
            direction /= np.linalg.norm(direction)
            wanted = Rotation.from_rotvec(axes @ (direction * TURN_SHARE * angle))
            step = (wanted * turned.inv()).as_rotvec()
            shift = pivot_world + rng.uniform(-1.0, 1.0, 3) * SHIFT_M - pivot
            shift[2] += attempt / TURN_TRIES * RAISE_M
            if np.linalg.norm(step) < 0.5 * config.turn_angle_rad[0]:
                continue
            if not _clear(local, turned, step, pivot, shift, config.table_clearance_m):
                continue
            seconds = np.linalg.norm(step) / config.turn_speed_rad_s
            paths.append(turn_about(at, pivot, step, shift, max(int(seconds / timestep_s), 50)))
            at = WristTarget(
                R_world_from_hand=paths[-1].R_world_from_hand[-1],
                position_world=paths[-1].positions_world[-1],
            )
            pivot, turned = pivot + shift, wanted
            break
    return paths


def _clear(
    local: Float[np.ndarray, "point 3"],
    turned: Rotation,
    step: Float[np.ndarray, "3"],
    pivot: Float[np.ndarray, "3"],
    shift: Float[np.ndarray, "3"],
    clearance_m: float,
) -> bool:
    for share in np.linspace(0.0, 1.0, PATH_CHECKS + 1)[1:]:
        R = (Rotation.from_rotvec(share * step) * turned).as_matrix()
        if (local @ R[2]).min() + pivot[2] + share * shift[2] < clearance_m:
            return False
    return True
