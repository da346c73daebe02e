"""An articulated hand for the physics engine, derived from any shaped MANO-format hand.

Everything comes from the model's own geometry (joints, skin weights, surface), so the
open hand, MANO and mirrored left hands share one path. "Hand frame" below is the rest
frame of the model moved to its rest wrist joint; "bone frame" has the same axes with the
origin at that bone's rest joint, which makes a hinge's rotation exactly a local MANO rotation.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from datagen.hands.model import ShapedHand
from shards.joints import DIGIT_JOINTS, DIGITS, Digit

__all__ = [
    "BoneHull",
    "HandBody",
    "Hinge",
    "Pad",
    "bone_transforms",
    "build_hand_body",
    "local_rotations",
]

# Finger strength relative to the index (grip dynamometer studies: ring 0.9, little 0.7).
STRENGTH = {"index": 1.0, "middle": 1.0, "ring": 0.9, "pinky": 0.7}


@dataclass(frozen=True, kw_only=True)
class Hinge:
    """One rotational degree of freedom. Hinges of one bone act in the order listed."""

    name: str
    digit: Digit
    bone: int
    role: Literal["spread", "flexion", "opposition"]
    axis_bone: Float[np.ndarray, "3"]  # unit; positive flexion closes the hand
    low_rad: float
    high_rad: float
    torque_nm: float  # limit of its actuator
    stiffness_nm: float  # Nm/rad of its position actuator


@dataclass(frozen=True, kw_only=True)
class BoneHull:
    """A convex collision part that moves with one bone."""

    bone: int
    verts_bone: Float[np.ndarray, "vert 3"]


@dataclass(frozen=True, kw_only=True)
class Pad:
    """The palmar centre of a digit's last bone and its outward normal."""

    digit: Digit
    bone: int
    position_bone: Float[np.ndarray, "3"]
    normal_bone: Float[np.ndarray, "3"]


@dataclass(frozen=True, kw_only=True)
class HandBody:
    """Skeleton, hinges, collision hulls and finger pads; lengths in metres."""

    joints_rest: Float[np.ndarray, "16 3"]
    parents: Int[np.ndarray, "16"]
    hinges: tuple[Hinge, ...]
    hulls: tuple[BoneHull, ...]
    pads: tuple[Pad, ...]  # in the order of DIGITS
    distal: Float[np.ndarray, "3"]  # unit, wrist to knuckles
    dorsal: Float[np.ndarray, "3"]  # unit, out of the back of the hand
    radial: Float[np.ndarray, "3"]  # unit, to the thumb's side


def unit(v: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """v / |v|."""
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def build_hand_body(hand: ShapedHand) -> HandBody:
    """Hinges, hulls and pads of a shaped hand. Deterministic; about 30 ms."""
    model = hand.model
    verts, joints = np.asarray(hand.verts_rest, float), np.asarray(hand.joints_rest, float)
    weights, faces = np.asarray(model.weights, float), np.asarray(model.faces)
    tips = verts[np.asarray(model.tip_ids)]  # model order: thumb, index, middle, ring, pinky
    distal, dorsal, radial = _palm_axes(joints, model.side)
    normals = trimesh.Trimesh(verts, faces, process=False).vertex_normals
    hinges: list[Hinge] = []
    pads = []
    for digit, tip in zip(DIGITS, tips):
        bones = DIGIT_JOINTS[digit]
        if digit == "thumb":
            axis = _thumb_flexion_axis(verts, weights, joints, tip, radial, distal)
            hinges += _thumb_hinges(axis, distal, dorsal, joints, tip)
        else:
            axis = unit(np.cross(dorsal, joints[bones[1]] - joints[bones[0]]))
            hinges += _finger_hinges(digit, axis, dorsal)
        pads.append(_pad(digit, axis, verts, normals, weights, joints, tip))
    return HandBody(
        joints_rest=joints,
        parents=np.asarray(model.parents),
        hinges=tuple(hinges),
        hulls=_hulls(verts, weights, joints),
        pads=tuple(pads),
        distal=distal,
        dorsal=dorsal,
        radial=radial,
    )


def _palm_axes(
    joints: Float[np.ndarray, "16 3"], side: str
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    knuckles = joints[[1, 4, 10, 7]]
    distal = unit(knuckles.mean(0) - joints[0])
    across = joints[1] - joints[7]
    radial = unit(across - (across @ distal) * distal)
    dorsal = np.cross(distal, radial)  # right hand; mirrored on the left
    return distal, dorsal if side == "right" else -dorsal, radial


def _thumb_flexion_axis(
    verts: Float[np.ndarray, "vert 3"],
    weights: Float[np.ndarray, "vert 16"],
    joints: Float[np.ndarray, "16 3"],
    tip: Float[np.ndarray, "3"],
    radial: Float[np.ndarray, "3"],
    distal: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "3"]:
    """The thumb's last bone is wider than thick: the wide direction is its flexion axis."""
    along = unit(tip - joints[15])
    points = verts[weights[:, 15] > 0.6] - joints[15]
    reach = points @ along
    middle = points[(reach > 0.35 * reach.max()) & (reach < 0.8 * reach.max())]
    flat = middle - np.outer(middle @ along, along)
    _, directions = np.linalg.eigh(np.cov(flat.T))
    axis = directions[:, 2] - (directions[:, 2] @ along) * along
    # Positive flexion carries the tip towards the little finger's side.
    towards = np.cross(axis, along)
    return unit(axis if towards @ (radial - 0.3 * distal) < 0 else -axis)


def _finger_hinges(digit: Digit, axis: Float[np.ndarray, "3"], dorsal: Float[np.ndarray, "3"]) -> list[Hinge]:
    """Ranges of a relaxed adult hand (active range of motion, without hyper-extension)."""
    strength = STRENGTH[digit]
    spread = np.deg2rad(10.0 if digit in ("middle", "ring") else 15.0)
    rows = [
        ("spread", 0, "spread", dorsal, -spread, spread, 0.5, 5.0),
        ("mcp", 0, "flexion", axis, np.deg2rad(-12.0), np.deg2rad(85.0), 0.6, 6.0),
        ("pip", 1, "flexion", axis, np.deg2rad(-2.0), np.deg2rad(100.0), 0.35, 4.0),
        ("dip", 2, "flexion", axis, np.deg2rad(-2.0), np.deg2rad(65.0), 0.2, 2.5),
    ]
    return [
        Hinge(
            name=f"{digit}_{name}",
            digit=digit,
            bone=DIGIT_JOINTS[digit][link],
            role=role,  # type: ignore[arg-type]
            axis_bone=about,
            low_rad=float(low),
            high_rad=float(high),
            torque_nm=torque * strength,
            stiffness_nm=stiffness,
        )
        for name, link, role, about, low, high, torque, stiffness in rows
    ]


def _thumb_hinges(
    axis: Float[np.ndarray, "3"],
    distal: Float[np.ndarray, "3"],
    dorsal: Float[np.ndarray, "3"],
    joints: Float[np.ndarray, "16 3"],
    tip: Float[np.ndarray, "3"],
) -> list[Hinge]:
    """Opposition is limited by the thumb's angle to the palm plane, whatever its rest angle."""
    across = np.cross(dorsal, distal)  # radial on the right hand, ulnar on the left
    swing = np.sign(across @ (tip - joints[13])) * distal * -1.0
    thumb = tip - joints[13]
    lateral = abs(float(thumb @ across))
    rest = float(np.arctan2(-(thumb @ dorsal), lateral))  # > 0: already in front of the palm
    low, high = np.deg2rad(-5.0) - rest, np.deg2rad(105.0) - rest
    rows = [
        ("opposition", 13, "opposition", swing, low, high, 1.2, 10.0),
        ("spread", 13, "spread", dorsal, np.deg2rad(-30.0), np.deg2rad(30.0), 1.2, 10.0),
        ("cmc", 13, "flexion", axis, np.deg2rad(-20.0), np.deg2rad(40.0), 1.2, 10.0),
        ("mcp", 14, "flexion", axis, np.deg2rad(-8.0), np.deg2rad(55.0), 0.8, 6.0),
        ("ip", 15, "flexion", axis, np.deg2rad(-12.0), np.deg2rad(75.0), 0.4, 4.0),
    ]
    return [
        Hinge(
            name=f"thumb_{name}",
            digit="thumb",
            bone=bone,
            role=role,  # type: ignore[arg-type]
            axis_bone=about,
            low_rad=float(lo),
            high_rad=float(hi),
            torque_nm=torque,
            stiffness_nm=stiffness,
        )
        for name, bone, role, about, lo, hi, torque, stiffness in rows
    ]


def _pad(
    digit: Digit,
    axis: Float[np.ndarray, "3"],
    verts: Float[np.ndarray, "vert 3"],
    normals: Float[np.ndarray, "vert 3"],
    weights: Float[np.ndarray, "vert 16"],
    joints: Float[np.ndarray, "16 3"],
    tip: Float[np.ndarray, "3"],
) -> Pad:
    bone = DIGIT_JOINTS[digit][2]
    along = unit(tip - joints[bone])
    palmar = unit(np.cross(axis, along))
    reach = (verts - joints[bone]) @ along / ((tip - joints[bone]) @ along)
    facing = normals @ palmar
    near = (weights[:, bone] > 0.6) & (facing > 0.75) & (np.abs(reach - 0.6) < 0.3)
    if not near.any():
        near = (weights[:, bone] > 0.6) & (facing > 0.4)
    return Pad(digit=digit, bone=bone, position_bone=verts[near].mean(0) - joints[bone], normal_bone=palmar)


def _hulls(
    verts: Float[np.ndarray, "vert 3"],
    weights: Float[np.ndarray, "vert 16"],
    joints: Float[np.ndarray, "16 3"],
) -> tuple[BoneHull, ...]:
    """One hull per finger bone, one per metacarpal ray for the palm."""
    dominant = weights.argmax(1)
    hulls = []
    for bone in range(1, 16):
        inside = (dominant == bone) | (weights[:, bone] > (0.3 if bone == 13 else 0.42))
        hulls.append(BoneHull(bone=bone, verts_bone=_hull(verts[inside] - joints[bone])))
    palm = verts[(dominant == 0)] - joints[0]
    rays = joints[[1, 4, 10, 7]] - joints[0]
    share = np.clip(np.einsum("pj,rj->pr", palm, rays) / (rays**2).sum(1), 0.0, 1.0)
    away = np.linalg.norm(palm[:, None] - share[..., None] * rays, axis=-1)
    in_palm = share.max(1) > 0.08  # leaves the cut at the wrist to the forearm
    for ray in range(4):
        band = in_palm & (away[:, ray] < away.min(1) + 0.003)
        hulls.append(BoneHull(bone=0, verts_bone=_hull(palm[band])))
    return tuple(hulls)


def _hull(points: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "vert 3"]:
    return np.asarray(trimesh.convex.convex_hull(points).vertices, float)


def local_rotations(
    body: HandBody, angles_rad: Float[np.ndarray, "*batch hinge"]
) -> Float[np.ndarray, "*batch 16 3 3"]:
    """Hinge angles -> the 16 local rotations of the MANO layout (the wrist's is the identity)."""
    batch = angles_rad.shape[:-1]
    flat = angles_rad.reshape(-1, angles_rad.shape[-1])
    rotations = np.tile(np.eye(3), (len(flat), 16, 1, 1))
    for column, hinge in enumerate(body.hinges):
        turn = Rotation.from_rotvec(flat[:, column, None] * hinge.axis_bone).as_matrix()
        rotations[:, hinge.bone] = rotations[:, hinge.bone] @ turn
    return rotations.reshape(*batch, 16, 3, 3)


def bone_transforms(
    body: HandBody, angles_rad: Float[np.ndarray, "batch hinge"]
) -> tuple[Float[np.ndarray, "batch 16 3 3"], Float[np.ndarray, "batch 16 3"]]:
    """Rotation and origin of every bone in the hand frame (origin at the wrist joint)."""
    local = local_rotations(body, angles_rad)
    rotation = local.copy()
    origin = np.zeros((len(local), 16, 3))
    for bone in range(1, 16):
        parent = int(body.parents[bone])
        rotation[:, bone] = rotation[:, parent] @ local[:, bone]
        offset = body.joints_rest[bone] - body.joints_rest[parent]
        origin[:, bone] = origin[:, parent] + rotation[:, parent] @ offset
    return rotation, origin
