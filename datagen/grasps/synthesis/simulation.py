"""One simulated attempt: approach, close, squeeze, lift, turn. 100 Hz record."""

from dataclasses import dataclass
from enum import Enum

import mujoco
import numpy as np
from jaxtyping import Float

from datagen.grasps.config import GraspConfig
from datagen.grasps.synthesis.physics_world import (
    PALM,
    GraspWorld,
    HandContacts,
    WristTarget,
    quaternion_wxyz,
)
from datagen.grasps.synthesis.preshapes import closing_rates
from datagen.grasps.synthesis.proposals import APPROACH_M, Proposal, closing_step
from datagen.grasps.synthesis.start_poses import Start
from datagen.grasps.synthesis.wrist_motion import WristPath, plan_turns, straight

__all__ = ["FRAME_RATE_HZ", "Failure", "MotionTrace", "simulate"]

FRAME_RATE_HZ = 100.0  # GraspXL's
CLOSE_SPEED_RAD_S = 2.0
TOUCH_FORCE_N = 0.15
SQUEEZE_S, SETTLE_S, END_S = 0.15, 0.2, 0.1
TIGHTEN = 0.12  # share of the squeeze added per frame while the grip is too weak
LOST_M = 0.05  # the object moved this far in the hand: dropped


class Failure(Enum):
    """Why an attempt was not kept."""

    NO_PLACEMENT = "no clear placement"
    NO_OPPOSITION = "closed without opposing contacts"
    LOST_ON_RELEASE = "lost when released"
    DROPPED_IN_LIFT = "dropped in lift"
    DROPPED_IN_TURN = "dropped while turned"
    NOT_RISEN = "did not rise enough"
    OFF_CENTER = "hand centre too far from object"
    FEW_DIGITS = "too few digits in contact"
    PENETRATION = "penetration too deep"
    SLIP = "slipped too far"
    NO_MOVEMENT = "moved too little"
    BELOW_TABLE = "hand or forearm below the table"


@dataclass(frozen=True, kw_only=True)
class MotionTrace:
    """What was simulated, at 100 Hz."""

    angles_rad: Float[np.ndarray, "frame hinge"]
    wrist_position_world: Float[np.ndarray, "frame 3"]
    R_world_from_hand: Float[np.ndarray, "frame 3 3"]
    T_world_from_obj: Float[np.ndarray, "frame 4 4"]
    force_n: Float[np.ndarray, "frame 6"]  # five digits in the order of DIGITS, then the palm
    grasp_frame: int
    lifted_frame: int


class _Recorder:
    """Steps the world and keeps every frame."""

    def __init__(self, world: GraspWorld) -> None:
        self.world = world
        self.every = round(1.0 / (FRAME_RATE_HZ * world.model.opt.timestep))
        self.steps = 0
        self.angles: list[Float[np.ndarray, " hinge"]] = []
        self.wrists: list[WristTarget] = []
        self.objects: list[Float[np.ndarray, "4 4"]] = []
        self.forces: list[Float[np.ndarray, "6"]] = []

    def step(self) -> bool:
        """Advance; True when a frame was recorded."""
        self.world.step()
        self.steps += 1
        if self.steps % self.every:
            return False
        mujoco.mj_kinematics(self.world.model, self.world.data)  # poses of the new state
        self.angles.append(self.world.angles())
        self.wrists.append(self.world.wrist())
        self.objects.append(self.world.T_world_from_obj())
        self.forces.append(self.world.contacts().digit_force_n())
        return True

    def rest(self, seconds: float) -> None:
        for _ in range(round(seconds * FRAME_RATE_HZ) * self.every):
            self.step()

    def follow(self, path: WristPath) -> None:
        """Drive the wrist."""
        for position, quaternion in zip(path.positions_world, quaternion_wxyz(path.R_world_from_hand)):
            self.world.drive_wrist(position, quaternion)
            self.step()

    def carry(self, path: WristPath) -> bool:
        """Drive the wrist; False as soon as the object leaves the hand."""
        before = object_in_hand(self.world)
        for position, quaternion in zip(path.positions_world, quaternion_wxyz(path.R_world_from_hand)):
            self.world.drive_wrist(position, quaternion)
            if self.step() and np.linalg.norm(object_in_hand(self.world) - before) > LOST_M:
                return False
        return True

    def trace(self, grasp_frame: int, lifted_frame: int) -> MotionTrace:
        return MotionTrace(
            angles_rad=np.array(self.angles),
            wrist_position_world=np.array([w.position_world for w in self.wrists]),
            R_world_from_hand=np.array([w.R_world_from_hand for w in self.wrists]),
            T_world_from_obj=np.array(self.objects),
            force_n=np.array(self.forces),
            grasp_frame=grasp_frame,
            lifted_frame=lifted_frame,
        )


def object_in_hand(world: GraspWorld) -> Float[np.ndarray, "3"]:
    """Centre of mass of the object in the wrist's frame, metres."""
    T, wrist = world.T_world_from_obj(), world.wrist()
    com = T[:3, :3] @ world.com_obj + T[:3, 3]
    return wrist.R_world_from_hand.T @ (com - wrist.position_world)


def simulate(
    world: GraspWorld, start: Start, proposal: Proposal, config: GraspConfig, rng: np.random.Generator
) -> MotionTrace | Failure:
    """Play one proposal; the failure says in which phase it ended."""
    timestep = float(world.model.opt.timestep)
    goal = proposal.wrist
    first = goal.moved(-APPROACH_M * proposal.approach_world)
    world.reset(first, proposal.angles_rad, start.T_world_from_obj, start.table_edge)
    recorder = _Recorder(world)
    way = APPROACH_M * proposal.approach_world
    recorder.follow(straight(first, way, round(config.approach_s / timestep)))
    recorder.rest(0.04)
    _close(world, recorder, proposal, config)
    contacts = world.contacts()
    force = contacts.digit_force_n()
    if not (force[1:PALM] > TOUCH_FORCE_N).any() or force[[0, PALM]].max() < TOUCH_FORCE_N:
        return Failure.NO_OPPOSITION
    squeeze = _squeeze(world, recorder, contacts, config)
    world.release_object()
    grasp_frame = len(recorder.angles)
    held = object_in_hand(world)
    _tighten(world, recorder, squeeze)
    force = world.contacts().digit_force_n()
    if np.linalg.norm(object_in_hand(world) - held) > 0.5 * LOST_M or (force > 0.05).sum() < 2:
        return Failure.LOST_ON_RELEASE
    lift = np.array([0.0, 0.0, rng.uniform(*config.lift_height_m)])
    if not recorder.carry(straight(goal, lift, round(config.lift_s / timestep))):
        return Failure.DROPPED_IN_LIFT
    lifted_frame = len(recorder.angles)
    lifted = goal.moved(lift)
    T = world.T_world_from_obj()
    pivot = T[:3, :3] @ world.com_obj + T[:3, 3]
    carried = _carried_points(world, config)
    for path in plan_turns(world.body, lifted, pivot, carried, config, timestep, rng):
        if not recorder.carry(path):
            return Failure.DROPPED_IN_TURN
        recorder.rest(0.04)
    recorder.rest(END_S)
    return recorder.trace(grasp_frame, lifted_frame)


def _close(world: GraspWorld, recorder: _Recorder, proposal: Proposal, config: GraspConfig) -> None:
    """Flex until every joint is stopped by the object, or the time is over."""
    rates = closing_rates(world.body, proposal.curl)
    target = proposal.angles_rad.copy()
    step = CLOSE_SPEED_RAD_S / FRAME_RATE_HZ
    for tick in range(round(config.close_s * FRAME_RATE_HZ)):
        contacts = world.contacts()
        touching = np.zeros(16)
        np.add.at(touching, contacts.bone, contacts.force_n)
        touching = np.where(touching > TOUCH_FORCE_N, touching, 0.0)
        ramp = min(1.0, (tick + 1) / 15.0)
        target, moving = closing_step(world, target, proposal.angles_rad, rates, step * ramp, touching)
        world.data.ctrl[:] = target
        recorder.rest(1.0 / FRAME_RATE_HZ)
        if not moving:
            break


@dataclass(frozen=True, kw_only=True)
class _Squeeze:
    """How the fingers press: their total force and the shift of the joint targets that makes it."""

    force_n: float
    shift_rad: Float[np.ndarray, " hinge"]


def _squeeze(world: GraspWorld, recorder: _Recorder, contacts: HandContacts, config: GraspConfig) -> _Squeeze:
    """Hold the present posture stiffly and press with a force that suits the weight.

    Torques come from the transposed contact Jacobians, so that thumb and fingers balance.
    """
    weight = world.mass_kg * 9.81
    total = float(np.clip(config.grip_factor * weight, *config.grip_force_n))
    row = world.row_of_bone[contacts.bone]
    pressing = contacts.force_n > 0.02
    fingers = sorted({int(r) for r in row[pressing] if 0 < r < PALM})
    torque = np.zeros(len(world.body.hinges))
    jacobian = np.zeros((3, world.model.nv))
    for digit in [0, *fingers]:
        rows = np.flatnonzero((row == digit) & pressing)
        share = (0.6 if (row[pressing] == PALM).any() else 1.0) if digit == 0 else 1.0 / len(fingers)
        for contact in rows:
            body = int(world.bone_body[contacts.bone[contact]])
            mujoco.mj_jac(world.model, world.data, jacobian, None, contacts.position_world[contact], body)
            push = contacts.normal_world[contact] * total * share / len(rows)
            torque += jacobian[:, world.hinge_dof].T @ push
    shift = np.clip(torque, -world.torque_nm, world.torque_nm) / world.stiffness_nm
    before, after = world.data.ctrl.copy(), world.angles() + shift
    frames = round(SQUEEZE_S * FRAME_RATE_HZ)
    for k in range(frames):
        world.data.ctrl[:] = before + (after - before) * min(1.0, 1.5 * (k + 1) / frames)
        recorder.rest(1.0 / FRAME_RATE_HZ)
    return _Squeeze(force_n=total, shift_rad=shift)


def _tighten(world: GraspWorld, recorder: _Recorder, squeeze: _Squeeze) -> None:
    """Settle after the release; press on while the fingers have lost force."""
    for _ in range(round(SETTLE_S * FRAME_RATE_HZ)):
        force = world.contacts().digit_force_n()
        if force[1:PALM].sum() < squeeze.force_n:
            world.data.ctrl[:] += TIGHTEN * squeeze.shift_rad
        recorder.rest(1.0 / FRAME_RATE_HZ)


def _carried_points(world: GraspWorld, config: GraspConfig) -> Float[np.ndarray, "point 3"]:
    """Points of hand, forearm and object that must stay above the table in a turn."""
    points = []
    for hull in world.body.hulls:
        bone = world.bone_body[hull.bone]
        R = world.data.xmat[bone].reshape(3, 3)
        points.append(hull.verts_bone @ R.T + world.data.xpos[bone])
    wrist = world.wrist()
    axis = wrist.R_world_from_hand @ world.body.distal
    radius = config.forearm_radius_m
    around = radius * np.concatenate([np.eye(3), -np.eye(3)])
    for back in (radius, 0.5 * config.forearm_length_m, config.forearm_length_m):
        points.append(wrist.position_world - back * axis + around)
    T = world.T_world_from_obj()
    points.append(world.object_verts_obj @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(points)
