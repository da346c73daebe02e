"""MANO-format hand: model -> shaped -> posed. One code path for every model of that layout.

Linear blend skinning as in smplx (FORMATS 3.2): joints from the shaped rest mesh, pose
blendshapes from vec(R - I) of the 15 finger joints, the root turns about the rest wrist
joint, the translation is added last.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

__all__ = [
    "PARENTS",
    "HandModel",
    "PosedHand",
    "ShapedHand",
    "load_open_hand",
    "mirror_axis_angle",
    "mirror_hand",
    "pose_hand",
    "shape_hand",
]

PARENTS = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)  # of MANO_JOINTS


@dataclass(frozen=True, kw_only=True, eq=False)
class HandModel:
    """A hand in MANO layout. Rest frame, metres; right hand: fingers to -x, thumb to +z, back of the hand +y."""

    name: str
    side: Literal["right", "left"]
    v_template: Float[np.ndarray, "vert 3"]
    shapedirs: Float[np.ndarray, "vert 3 beta"]
    posedirs: Float[np.ndarray, "vert 3 135"]
    J_regressor: Float[np.ndarray, "16 vert"]
    weights: Float[np.ndarray, "vert 16"]
    faces: Int[np.ndarray, "face 3"]
    parents: Int[np.ndarray, "16"]
    hands_mean: Float[np.ndarray, "45"]
    tip_ids: Int[np.ndarray, "5"]  # thumb, index, middle, ring, pinky
    corner_uv: Float[np.ndarray, "face 3 2"]  # (0, 0) is the lower left of the texture
    wrist_loop: Int[np.ndarray, " loop"]  # border of the wrist, in order around it


@dataclass(frozen=True, kw_only=True, eq=False)
class ShapedHand:
    """A model with shape coefficients applied. Rest frame, metres."""

    model: HandModel
    betas: Float[np.ndarray, " beta"]
    verts_rest: Float[np.ndarray, "vert 3"]
    joints_rest: Float[np.ndarray, "16 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedHand:
    """A shaped hand in every frame of a motion. World, metres."""

    verts_world: Float[np.ndarray, "frame vert 3"]
    T_world_from_joint: Float[np.ndarray, "frame 16 4 4"]
    joints_world: Float[np.ndarray, "frame 21 3"]  # 16 joints, then the five tips


def shape_hand(model: HandModel, betas: Float[np.ndarray, " beta"]) -> ShapedHand:
    """Apply shape coefficients. ValueError when there are more of them than the model has."""
    n = model.shapedirs.shape[2]
    if len(betas) > n:
        raise ValueError(f"hand model {model.name!r} has {n} shape coefficients, found {len(betas)}")
    verts_rest = model.v_template + model.shapedirs[..., : len(betas)] @ betas
    return ShapedHand(
        model=model, betas=betas, verts_rest=verts_rest, joints_rest=model.J_regressor @ verts_rest
    )


def pose_hand(
    shaped: ShapedHand,
    *,
    orientation_world: Float[np.ndarray, "frame 3"],
    hand_pose: Float[np.ndarray, "frame 45"],
    translation_world: Float[np.ndarray, "frame 3"],
    flat_hand_mean: bool,
) -> PosedHand:
    """Axis-angle pose to vertices and joints. `hand_pose` is an offset from the mean pose unless `flat_hand_mean`."""
    model = shaped.model
    n_frames = len(orientation_world)
    full_pose = hand_pose if flat_hand_mean else hand_pose + model.hands_mean
    axis_angle = np.concatenate([orientation_world[:, None], full_pose.reshape(n_frames, 15, 3)], axis=1)
    R = Rotation.from_rotvec(axis_angle.reshape(-1, 3)).as_matrix().reshape(n_frames, 16, 3, 3)

    pose_feature = (R[:, 1:] - np.eye(3)).reshape(n_frames, 135)
    verts = shaped.verts_rest + np.einsum("vck,fk->fvc", model.posedirs, pose_feature)

    T_world_from_joint = _chain(R, shaped.joints_rest, model.parents)
    A = T_world_from_joint.copy()  # moves rest-frame points along with each joint
    A[..., :3, 3] -= np.einsum("fjab,jb->fja", A[..., :3, :3], shaped.joints_rest)
    blended = np.einsum("vj,fjab->fvab", model.weights, A[..., :3, :])
    verts_world = np.einsum("fvab,fvb->fva", blended[..., :3], verts) + blended[..., 3]

    verts_world += translation_world[:, None]
    T_world_from_joint[..., :3, 3] += translation_world[:, None]
    joints_world = np.concatenate([T_world_from_joint[..., :3, 3], verts_world[:, model.tip_ids]], axis=1)
    return PosedHand(
        verts_world=verts_world, T_world_from_joint=T_world_from_joint, joints_world=joints_world
    )


def _chain(
    R: Float[np.ndarray, "frame 16 3 3"],
    joints_rest: Float[np.ndarray, "16 3"],
    parents: Int[np.ndarray, "16"],
) -> Float[np.ndarray, "frame 16 4 4"]:
    """Forward kinematics: compose local rotations about the rest joints from the wrist outward."""
    T = np.zeros((len(R), 16, 4, 4))
    T[..., 3, 3] = 1.0
    T[..., :3, :3] = R
    T[:, 0, :3, 3] = joints_rest[0]
    for joint in range(1, 16):
        parent = parents[joint]
        T[:, joint, :3, 3] = joints_rest[joint] - joints_rest[parent]
        T[:, joint] = T[:, parent] @ T[:, joint]
    return T


def mirror_axis_angle(rotation: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """The rotation seen in the mirror x -> -x: the axis keeps x, y and z change sign."""
    return rotation * np.array([1.0, -1.0, -1.0])


def mirror_hand(model: HandModel) -> HandModel:
    """The other hand: every rest-frame quantity mirrored in x, faces turned to stay outward."""
    flip = np.array([-1.0, 1.0, 1.0])
    # posedirs act on vec(R - I); mirroring R -> S R S flips the sign of the entries with one x index.
    sign = np.tile(np.outer(flip, flip).reshape(9), 15)
    return replace(
        model,
        side="left" if model.side == "right" else "right",
        v_template=model.v_template * flip,
        shapedirs=model.shapedirs * flip[:, None],
        posedirs=model.posedirs * flip[:, None] * sign,
        faces=model.faces[:, ::-1].copy(),
        hands_mean=mirror_axis_angle(model.hands_mean.reshape(15, 3)).reshape(45),
        corner_uv=model.corner_uv[:, ::-1].copy(),
        wrist_loop=model.wrist_loop[::-1].copy(),
    )


@lru_cache(maxsize=2)
def load_open_hand(side: Literal["right", "left"] = "right") -> HandModel:
    """The CC0 hand that ships with the package."""
    with (files("datagen.hands") / "data" / "open_hand.npz").open("rb") as file, np.load(file) as data:
        arrays = {name: data[name] for name in data.files}
    model = HandModel(
        name="openhand",
        side="right",
        v_template=arrays["v_template"].astype(np.float64),
        shapedirs=arrays["shapedirs"].astype(np.float64),
        posedirs=arrays["posedirs"].astype(np.float64),
        J_regressor=arrays["J_regressor"].astype(np.float64),
        weights=arrays["weights"].astype(np.float64),
        faces=arrays["faces"].astype(np.int64),
        parents=np.array(PARENTS),
        hands_mean=arrays["hands_mean"].astype(np.float64),
        tip_ids=arrays["tip_ids"].astype(np.int64),
        corner_uv=arrays["corner_uv"].astype(np.float64),
        wrist_loop=arrays["wrist_loop"].astype(np.int64),
    )
    return model if side == "right" else mirror_hand(model)
