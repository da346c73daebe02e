"""GraspConfig: every number of the synthesiser that a user may want to change."""

from dataclasses import dataclass
from typing import Annotated

from shards.settings import Range

__all__ = ["GraspConfig"]


@dataclass(frozen=True, kw_only=True)
class GraspConfig:
    """Settings of one grasp synthesis. Metres, radians, newtons, seconds."""

    max_attempts: Annotated[int, Range(1, 100_000)]
    # How the motion may begin; weights of a random choice, 0 switches a kind off.
    table_start_weight: Annotated[float, Range(0, 1e6)]  # the object rests on the table
    edge_start_weight: Annotated[float, Range(0, 1e6)]  # a flat object overhangs the table edge
    # the object is presented in mid-air (drawn once it is held)
    held_start_weight: Annotated[float, Range(0, 1e6)]
    # Proposals
    contact_pairs: Annotated[int, Range(1, 1_000_000)]  # antipodal pairs tried per start
    proposals: Annotated[int, Range(1, 100_000)]  # collision-free hand placements wanted per start
    # best placements simulated before the object is put down anew
    simulated_per_start: Annotated[int, Range(1, 100_000)]
    # Object
    density_kg_m3: Annotated[float, Range(1, 30_000)]
    mass_kg: Annotated[tuple[float, float], Range(0.001, 10, rising=True)]  # lowest, highest
    friction: Annotated[float, Range(0.01, 10)]  # sliding, hand on object
    # Grip
    grip_factor: Annotated[float, Range(0, 100)]  # grip force per object weight
    # lowest, highest sum over the fingers
    grip_force_n: Annotated[tuple[float, float], Range(0, 1000, rising=True)]
    contact_distance_m: Annotated[float, Range(0, 0.1)]  # skin rests this far off the collision parts
    # Forearm, straight behind the wrist
    forearm_length_m: Annotated[float, Range(0.05, 0.6)]
    forearm_radius_m: Annotated[float, Range(0.01, 0.2)]
    table_clearance_m: Annotated[float, Range(0, 1)]  # hand and forearm above the table
    # Motion
    approach_s: Annotated[float, Range(0.05, 60)]
    close_s: Annotated[float, Range(0.05, 60)]
    lift_s: Annotated[float, Range(0.05, 60)]
    lift_height_m: Annotated[tuple[float, float], Range(0, 2, rising=True)]
    # wrist turns after the lift, fewest and most
    turns: Annotated[tuple[int, int], Range(0, 100, rising=True)]
    turn_angle_rad: Annotated[tuple[float, float], Range(0, 6.3, rising=True)]
    turn_speed_rad_s: Annotated[float, Range(0.01, 20)]
    # What is kept
    min_rise_m: Annotated[float, Range(0, 2)]
    max_center_distance_m: Annotated[float, Range(0, 2)]
    min_digits: Annotated[int, Range(0, 5)]
    max_penetration_m: Annotated[float, Range(0, 1)]
    max_slip_m: Annotated[float, Range(0, 1)]
    min_movement_rad: Annotated[float, Range(0, 100)]  # rotation range of the object
