"""A motion recorded with another hand, fitted to the object for the hand that stands in for it.

The recorded wrist path and finger angles put a hand of other proportions into the object or beside it.
The fit looks for the smallest smooth correction (wrist shift and turn, hinge angles) at knots along the
motion, by Gauss-Newton on: depth of every hand vertex beyond the skin's give; gap of the digits that
grip while the object is held; departure from the recorded motion; change from knot to knot.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import CubicSpline

from datagen.grasps.hand_body import HandBody, build_hand_body
from datagen.grasps.hand_parameters import HandParameters
from datagen.grasps.object_surface import ObjectSurface
from datagen.grasps.recorded.stand_in_hinges import (
    HingedMotion,
    corrected,
    hinge_shares,
    hinge_turns,
    hinged_readings,
    motion_at,
    palmar_pads,
    pose_hinged,
    skin_normals,
    to_parameters,
    wrist_pivot,
)
from datagen.hands.model import PosedHand, ShapedHand

__all__ = ["REFERENCE_STAND_IN", "StandInConfig", "fitted_stand_in"]

_PATCH = 5  # nearest vertices of a pad whose mean distance is its gap
_ON_SURFACE_M = 1e-5
# A sunken vertex whose nearest way out leads through the finger itself says little about the way back.
_THROUGH = 0.2  # cosine between that way and the skin's normal
_THROUGH_WEIGHT = 0.1
_DIFFERENCE = np.array([[1.0, -1.0], [-1.0, 1.0]])  # quadratic form of (a - b)^2
_WRIST = 6  # parameters of a correction before the hinges: shift (3), turn (3)


@dataclass(frozen=True, kw_only=True)
class StandInConfig:
    """How a recorded motion is fitted. The `_std` values weigh against each other in least squares."""

    grip_instants: int  # spread over the held frames, for which the grip is found first
    grip_iterations: int  # of Gauss-Newton
    knot_frames: int  # then along the whole motion: frames from knot to knot
    knot_iterations: int
    max_zero_shift_rad: float  # of a hinge that goes beyond its range as recorded
    skin_give_m: float  # depth that the skin of a pressed finger allows
    depth_std_m: float  # of one vertex beyond that
    gap_std_m: float  # of a digit that grips
    gap_outlier_m: float  # gaps beyond this hardly pull any more
    reach_m: float  # fingers nearer than this (median over the held knots) grip; the thumb always does
    rise_m: float  # an object that has risen so far is held, whether it still slides or not
    shift_std_m: float  # wrist shift
    turn_std_rad: float  # wrist turn
    flexion_std_rad: float  # hinges that bend; also the thumb's opposition
    spread_std_rad: float
    neighbour_std_rad: float  # difference of the corrections of neighbouring fingers' same hinges
    grip_change: float  # change from instant to instant, in units of the std above
    held_change: float  # ... from knot to knot while held
    approach_change: float  # ... and before
    max_shift_m: float  # of the wrist along each axis of the hand
    max_turn_rad: float  # ... and about each
    max_step_std: float  # largest change of a parameter in one iteration, in units of its std

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"stand_in.{name} is {value}: expected a positive number")


# Chosen on GraspXL's sample (DECISIONS D15).
REFERENCE_STAND_IN = StandInConfig(
    grip_instants=5,
    grip_iterations=10,
    knot_frames=6,
    knot_iterations=4,
    max_zero_shift_rad=0.5,
    skin_give_m=0.0005,
    depth_std_m=0.0008,
    gap_std_m=0.0015,
    gap_outlier_m=0.015,
    reach_m=0.02,
    rise_m=0.01,
    shift_std_m=0.008,
    turn_std_rad=0.14,
    flexion_std_rad=0.2,
    spread_std_rad=0.09,
    neighbour_std_rad=0.14,
    grip_change=0.02,
    held_change=0.12,
    approach_change=0.35,
    max_shift_m=0.025,
    max_turn_rad=0.35,
    max_step_std=1.5,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Hand:
    """What the fit needs to know of the hand."""

    shaped: ShapedHand
    body: HandBody
    pads: tuple[Int[np.ndarray, " _"], ...]  # palmar vertices of each digit's two outer bones
    bone_of: Int[np.ndarray, " vert"]  # that moves a vertex most
    outward: Float[np.ndarray, "vert 3"]  # normals at rest, unit
    follows: Float[np.ndarray, "vert hinge"]  # share of a hinge's turn that a vertex follows
    low_rad: Float[np.ndarray, " hinge"]
    high_rad: Float[np.ndarray, " hinge"]
    std: Float[np.ndarray, " parameter"]  # of a correction: wrist shift (3), wrist turn (3), hinges


@dataclass(frozen=True, kw_only=True, eq=False)
class _Fit:
    """One least-squares problem: the motion at the knots, corrected by one vector at each."""

    hand: _Hand
    surface: ObjectSurface
    motion: HingedMotion
    T_world_from_obj: Float[np.ndarray, "knot 4 4"]
    held: Bool[np.ndarray, " knot"]
    config: StandInConfig


@dataclass(frozen=True, kw_only=True, eq=False)
class _Solution:
    correction: Float[np.ndarray, "knot parameter"]
    cost: float  # sum of squared residuals per knot


@dataclass(frozen=True, kw_only=True, eq=False)
class _Near:
    """Signed distances (m) of the hand's vertices to the surface. Only those that matter are looked up:
    the others are known to lie between their bounds, which widen as the vertex moves."""

    posed: PosedHand
    least_m: Float[np.ndarray, "knot vert"]
    most_m: Float[np.ndarray, "knot vert"]
    verts_obj: Float[np.ndarray, "knot vert 3"]
    gradient_world: Float[np.ndarray, "knot vert 3"]  # unit; 0 where not looked up
    outward_world: Float[np.ndarray, "knot vert 3"]  # normals of the skin, unit


def fitted_stand_in(
    hand: ShapedHand,
    parameters: HandParameters,
    T_world_from_obj: Float[np.ndarray, "frame 4 4"],
    surface: ObjectSurface,
    *,
    carried_from: int,
    config: StandInConfig,
) -> HandParameters:
    """A smooth motion of `hand` whose gripping digits touch the object from `carried_from` on.

    `parameters`: recorded finger angles as offsets from the mean pose, wrist joint where recorded.
    Deterministic. A motion that never grips stays without grip: its contacts must be measured.
    """
    frames = len(T_world_from_obj)
    held_from = min(carried_from, _risen_from(T_world_from_obj, config.rise_m), frames - 1)
    instants = _spread(held_from, frames - 1, config.grip_instants)
    knots = _spread(0, frames - 1, round(frames / config.knot_frames) + 1)
    parts = _hand(hand, config)

    def fit(motion: HingedMotion, rows: Int[np.ndarray, " row"]) -> _Fit:
        return _Fit(
            hand=parts,
            surface=surface,
            motion=motion_at(motion, rows),
            T_world_from_obj=T_world_from_obj[rows],
            held=rows >= held_from,
            config=config,
        )

    # Whether the zeros of the two hands differ shows in which reading of the angles fits better.
    readings = hinged_readings(hand, parts.body, parameters, config.max_zero_shift_rad)
    still = np.zeros((len(instants), len(parts.std)))
    grips = [
        _solve(fit(motion, instants), still, config.grip_iterations, config.grip_change)
        for motion in readings
    ]
    best = min(range(len(readings)), key=lambda k: grips[k].cost)
    motion, grip = readings[best], grips[best].correction
    start = np.stack([np.interp(knots, instants, column) for column in grip.T], axis=1)
    correction = _solve(fit(motion, knots), start, config.knot_iterations, config.held_change).correction
    every = CubicSpline(knots, correction, bc_type="natural")(np.arange(frames))
    return to_parameters(hand, parts.body, corrected(motion, parts.body, every))


def _spread(first: int, last: int, count: int) -> Int[np.ndarray, " _"]:
    """`count` frames from first to last, or every frame where there are fewer."""
    return np.unique(np.linspace(first, last, max(count, 2)).round().astype(int))


def _risen_from(T_world_from_obj: Float[np.ndarray, "frame 4 4"], rise_m: float) -> int:
    """First frame from which on the object is off the table (one past the end: never)."""
    low = np.flatnonzero(T_world_from_obj[:, 2, 3] - T_world_from_obj[0, 2, 3] < rise_m)
    return int(low[-1]) + 1


def _hand(hand: ShapedHand, config: StandInConfig) -> _Hand:
    body = build_hand_body(hand)
    hinges = [config.spread_std_rad if h.role == "spread" else config.flexion_std_rad for h in body.hinges]
    return _Hand(
        shaped=hand,
        body=body,
        pads=palmar_pads(hand, body),
        bone_of=hand.model.weights.argmax(axis=1),
        outward=skin_normals(hand),
        follows=hinge_shares(hand.model, body),
        low_rad=np.array([hinge.low_rad for hinge in body.hinges]),
        high_rad=np.array([hinge.high_rad for hinge in body.hinges]),
        std=np.array([config.shift_std_m] * 3 + [config.turn_std_rad] * 3 + hinges),
    )


def _solve(
    fit: _Fit, start: Float[np.ndarray, "knot parameter"], iterations: int, held_change: float
) -> _Solution:
    """Gauss-Newton over all knots at once, in units of the standard deviations; its best iterate."""
    std, config = fit.hand.std, fit.config
    knots, size = len(fit.held), len(std)
    wrist = np.tile([config.max_shift_m] * 3 + [config.max_turn_rad] * 3, (knots, 1))
    low = np.concatenate([-wrist, fit.hand.low_rad - fit.motion.angles_rad], axis=1) / std
    high = np.concatenate([wrist, fit.hand.high_rad - fit.motion.angles_rad], axis=1) / std
    stiff = _regularisation(fit, held_change)
    scaled = start / std
    best = _Solution(correction=start, cost=np.inf)
    grips, near = None, None
    for _ in range(iterations + 1):
        moved = corrected(fit.motion, fit.hand.body, scaled * std)
        near = _near(fit, moved, near)
        grips = _gripping(fit, near) if grips is None else grips
        normal, gradient = stiff.copy(), stiff @ scaled.reshape(-1)
        cost = float(scaled.reshape(-1) @ gradient)
        blocks = normal.reshape(knots, size, knots, size)
        for knot, (residual, jacobian) in enumerate(_rows(fit, moved, near, grips)):
            blocks[knot, :, knot] += (jacobian * std).T @ (jacobian * std)
            gradient[knot * size : (knot + 1) * size] += (jacobian * std).T @ residual
            cost += float(residual @ residual)
        if cost / knots < best.cost:
            best = _Solution(correction=scaled * std, cost=cost / knots)
        step = np.clip(_step(normal, gradient, scaled, low, high), -config.max_step_std, config.max_step_std)
        scaled = np.clip(scaled + step, low, high)
    return best


def _step(
    normal: Float[np.ndarray, "n n"],
    gradient: Float[np.ndarray, " n"],
    scaled: Float[np.ndarray, "knot parameter"],
    low: Float[np.ndarray, "knot parameter"],
    high: Float[np.ndarray, "knot parameter"],
) -> Float[np.ndarray, "knot parameter"]:
    """Gauss-Newton step in which what presses against its limits stays there."""
    downhill = -gradient.reshape(scaled.shape)
    stuck = ((scaled <= low) & (downhill < 0.0)) | ((scaled >= high) & (downhill > 0.0))
    free = np.flatnonzero(~stuck.reshape(-1))
    step = np.zeros(scaled.size)
    step[free] = np.linalg.solve(normal[np.ix_(free, free)], -gradient[free])
    return step.reshape(scaled.shape)


def _regularisation(fit: _Fit, held_change: float) -> Float[np.ndarray, "n n"]:
    """Quadratic form of departure, difference of neighbouring fingers and change from knot to knot."""
    hinges, std = fit.hand.body.hinges, fit.hand.std
    own = np.eye(len(std))
    column = {hinge.name: _WRIST + k for k, hinge in enumerate(hinges)}
    weight = (fit.config.flexion_std_rad / fit.config.neighbour_std_rad) ** 2
    for one, other in (("index", "middle"), ("middle", "ring"), ("ring", "pinky")):
        for joint in ("mcp", "pip", "dip"):
            pair = [column[f"{one}_{joint}"], column[f"{other}_{joint}"]]
            own[np.ix_(pair, pair)] += weight * _DIFFERENCE
    both_held = fit.held[1:] & fit.held[:-1]
    change = np.where(both_held, held_change, fit.config.approach_change)
    along = np.zeros((len(fit.held), len(fit.held)))
    for knot, units in enumerate(change):
        along[knot : knot + 2, knot : knot + 2] += _DIFFERENCE / units**2
    return np.kron(np.eye(len(fit.held)), own) + np.kron(along, np.eye(len(std)))


def _near(fit: _Fit, moved: HingedMotion, before: _Near | None) -> _Near:
    """Looks up the vertices that may be inside the object or be among the nearest of their pad."""
    posed = pose_hinged(fit.hand.shaped, fit.hand.body, moved)
    R, t = fit.T_world_from_obj[:, :3, :3], fit.T_world_from_obj[:, :3, 3]
    verts_obj = (posed.verts_world - t[:, None]) @ R
    outside = np.maximum(fit.surface.low - verts_obj, verts_obj - fit.surface.high)
    least = np.linalg.norm(np.maximum(outside, 0.0), axis=-1)  # to the bounding box
    least[least == 0.0] = -np.inf
    most = np.full(least.shape, np.inf)
    if before is not None:
        way = np.linalg.norm(verts_obj - before.verts_obj, axis=-1)
        least, most = np.maximum(least, before.least_m - way), before.most_m + way
    wanted = least < -fit.config.skin_give_m
    for pad in fit.hand.pads:
        fifth = np.partition(most[:, pad], _PATCH - 1, axis=1)[:, _PATCH - 1]
        wanted[:, pad] |= (least[:, pad] <= fifth[:, None]) & fit.held[:, None]
    gradient = np.zeros_like(verts_obj)
    least[wanted], gradient[wanted] = _distance_and_gradient(fit.surface, verts_obj[wanted])
    most[wanted] = least[wanted]
    bones = posed.T_world_from_joint[..., :3, :3]
    return _Near(
        posed=posed,
        least_m=least,
        most_m=most,
        verts_obj=verts_obj,
        outward_world=np.einsum("kvab,vb->kva", bones[:, fit.hand.bone_of], fit.hand.outward),
        gradient_world=gradient @ R.transpose(0, 2, 1),
    )


def _distance_and_gradient(
    surface: ObjectSurface, points_obj: Float[np.ndarray, "point 3"]
) -> tuple[Float[np.ndarray, " point"], Float[np.ndarray, "point 3"]]:
    """Signed distance (m, negative inside) and its unit gradient, object frame."""
    signed, face, closest, _ = igl.signed_distance(
        np.ascontiguousarray(points_obj),
        surface.verts,
        surface.faces,
        igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
    )
    away = points_obj - closest
    corners = surface.verts[surface.faces[face]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # On the surface the direction to the closest point is lost: its face tells.
    on_surface = np.abs(signed) < _ON_SURFACE_M
    gradient = np.where(on_surface[:, None], normal, np.where(signed < 0.0, -1.0, 1.0)[:, None] * away)
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    return signed, gradient / np.maximum(length, 1e-12)


def _gripping(fit: _Fit, near: _Near) -> Bool[np.ndarray, "5"]:
    """Digits that grip: fingers within reach of the surface as recorded, and the thumb."""
    gaps = [np.median(near.most_m[fit.held][:, pad].min(axis=1)) for pad in fit.hand.pads]
    grips = np.array(gaps) < fit.config.reach_m
    grips[0] = True
    return grips


def _rows(
    fit: _Fit,
    moved: HingedMotion,
    near: _Near,
    grips: Bool[np.ndarray, "5"],
) -> Iterator[tuple[Float[np.ndarray, " row"], Float[np.ndarray, "row parameter"]]]:
    """Residuals (in standard deviations) and Jacobian of each knot: sunken vertices, then gaps."""
    config = fit.config
    axes, origins = hinge_turns(fit.hand.body, moved, near.posed)
    pivots = near.posed.T_world_from_joint[:, 0, :3, 3] + np.einsum(
        "kab,b->ka", moved.R_world_from_hand, wrist_pivot(fit.hand.body)
    )
    for knot in range(len(fit.held)):
        distance = near.least_m[knot]
        sunk = np.flatnonzero(distance < -config.skin_give_m)
        touching = [pad for pad, grip in zip(fit.hand.pads, grips) if grip and fit.held[knot]]
        nearest = [pad[np.argsort(near.most_m[knot, pad], kind="stable")[:_PATCH]] for pad in touching]
        verts = np.concatenate([sunk, *nearest]).astype(int)
        gradient = near.gradient_world[knot, verts]
        points = near.posed.verts_world[knot, verts]
        R = fit.motion.R_world_from_hand[knot]
        jacobian = np.zeros((len(verts), len(fit.hand.std)))
        jacobian[:, :3] = gradient @ R
        jacobian[:, 3:_WRIST] = np.cross(points - pivots[knot], gradient) @ R
        arm = points[:, None] - origins[knot]
        turned = np.einsum("vhc,vhc->vh", np.cross(axes[knot], arm), gradient[:, None])
        jacobian[:, _WRIST:] = fit.hand.follows[verts] * turned
        residual = distance[verts].copy()
        through = np.einsum("vc,vc->v", gradient[: len(sunk)], near.outward_world[knot, sunk]) > _THROUGH
        weight = np.where(through, _THROUGH_WEIGHT, 1.0) / config.depth_std_m
        residual[: len(sunk)] = weight * (residual[: len(sunk)] + config.skin_give_m)
        jacobian[: len(sunk)] *= weight[:, None]
        if not touching:
            yield residual, jacobian
            continue
        gap = residual[len(sunk) :].reshape(-1, _PATCH).mean(1)
        weight = 1.0 / (config.gap_std_m * (1.0 + (gap / config.gap_outlier_m) ** 2))
        rows = jacobian[len(sunk) :].reshape(len(gap), _PATCH, -1).mean(1)
        yield (
            np.concatenate([residual[: len(sunk)], weight * gap]),
            np.concatenate([jacobian[: len(sunk)], weight[:, None] * rows]),
        )
