"""GraspConfig: every number of the synthesiser that a user may want to change."""

from dataclasses import dataclass

__all__ = ["GraspConfig"]


@dataclass(frozen=True, kw_only=True)
class GraspConfig:
    """Settings of one grasp synthesis. Metres, radians, newtons, seconds."""

    max_attempts: int
    # How the motion may begin; weights of a random choice, 0 switches a kind off.
    table_start_weight: float  # the object rests on the table
    edge_start_weight: float  # a flat object overhangs the table edge
    held_start_weight: float  # the object is presented in mid-air (drawn once it is held)
    # Proposals
    contact_pairs: int  # antipodal pairs tried per start
    proposals: int  # collision-free hand placements wanted per start
    simulated_per_start: int  # best placements simulated before the object is put down anew
    # Object
    density_kg_m3: float
    mass_kg: tuple[float, float]  # lowest, highest
    friction: float  # sliding, hand on object
    # Grip
    grip_factor: float  # grip force per object weight
    grip_force_n: tuple[float, float]  # lowest, highest sum over the fingers
    contact_distance_m: float  # skin rests this far off the collision parts
    # Forearm, straight behind the wrist
    forearm_length_m: float
    forearm_radius_m: float
    table_clearance_m: float  # hand and forearm above the table
    # Motion
    approach_s: float
    close_s: float
    lift_s: float
    lift_height_m: tuple[float, float]
    turns: tuple[int, int]  # wrist turns after the lift, fewest and most
    turn_angle_rad: tuple[float, float]
    turn_speed_rad_s: float
    # What is kept
    min_rise_m: float
    max_center_distance_m: float
    min_digits: int
    max_penetration_m: float
    max_slip_m: float
    min_movement_rad: float  # rotation range of the object
