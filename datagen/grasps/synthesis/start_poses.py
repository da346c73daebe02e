"""How a motion may begin: the object on the table, over its edge, or held out in mid-air."""

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from datagen.grasps.config import GraspConfig
from datagen.grasps.sequence import StartKind, TableEdge
from datagen.objects.asset.object_asset import ObjectAsset

__all__ = ["START_KINDS", "RestingPoses", "Start", "resting_poses", "sample_start"]

SUPPORT_TOLERANCE_M = 0.001
FLAT_HEIGHT_M = 0.03  # lower objects leave the fingers little room above the table
LOW_HEIGHT_M = 0.09  # up to here a hand can close over an overhanging end
HELD_HEIGHT_M = 0.3
START_KINDS: tuple[StartKind, ...] = ("table", "edge", "held")
UPRIGHT_BONUS = 3.0  # household objects usually stand as they were modelled


@dataclass(frozen=True, kw_only=True)
class RestingPoses:
    """Orientations in which the object stays put on a table, likeliest first."""

    R_world_from_obj: Float[np.ndarray, "pose 3 3"]
    weight: Float[np.ndarray, " pose"]  # sums to 1
    height_m: Float[np.ndarray, " pose"]
    hull_verts_obj: Float[np.ndarray, "vert 3"]
    com_obj: Float[np.ndarray, "3"]


@dataclass(frozen=True, kw_only=True)
class Start:
    """Where the object is before the hand comes."""

    kind: StartKind
    option: tuple[int, int]  # resting pose, row of START_KINDS
    T_world_from_obj: Float[np.ndarray, "4 4"]
    table_edge: TableEdge | None


def resting_poses(obj: ObjectAsset, com_obj: Float[np.ndarray, "3"]) -> RestingPoses:
    """Stable orientations of the convex hull; the modelled one alone when there is none (a ball)."""
    verts = np.concatenate([part.verts_obj for part in obj.watertight.parts])
    hull = trimesh.convex.convex_hull(verts)
    verts = np.asarray(hull.vertices, float)
    order = np.argsort(-hull.area_faces, kind="stable")
    downs = [np.array([0.0, 0.0, -1.0])]
    for normal in np.asarray(hull.face_normals)[order]:
        if len(downs) < 60 and max(float(normal @ down) for down in downs) < 0.998:
            downs.append(normal)
    rotations, weights, heights = [], [], []
    for k, down in enumerate(downs):
        R = Rotation.align_vectors([[0.0, 0.0, -1.0]], [down])[0].as_matrix() if k else np.eye(3)
        placed, com = verts @ R.T, R @ com_obj
        height = com[2] - placed[:, 2].min()
        margin = _support_margin(placed, com)
        if margin > 0.002:
            rotations.append(R)
            weights.append(np.arctan2(margin, height) * (UPRIGHT_BONUS if k == 0 else 1.0))
            heights.append(np.ptp(placed[:, 2]))
    if not rotations:
        rotations, weights, heights = [np.eye(3)], [1.0], [float(np.ptp(verts[:, 2]))]
    weight = np.array(weights) ** 2
    rank = np.argsort(-weight, kind="stable")
    return RestingPoses(
        R_world_from_obj=np.array(rotations)[rank],
        weight=(weight / weight.sum())[rank],
        height_m=np.array(heights)[rank],
        hull_verts_obj=verts,
        com_obj=com_obj,
    )


def _support_margin(placed: Float[np.ndarray, "vert 3"], com: Float[np.ndarray, "3"]) -> float:
    """Distance (m) of the centre of mass from the border of the support polygon, < 0 outside."""
    support = placed[placed[:, 2] < placed[:, 2].min() + SUPPORT_TOLERANCE_M][:, :2]
    if len(support) < 3:
        return -1.0
    try:
        sides = ConvexHull(support).equations
    except QhullError:  # all support points on one line
        return -1.0
    return float(-(sides[:, :2] @ com[:2] + sides[:, 2]).max())


def sample_start(
    poses: RestingPoses, trust: Float[np.ndarray, "pose 3"], config: GraspConfig, rng: np.random.Generator
) -> Start:
    """A random start; `trust` (1 at first) scales the chance of every pose and kind of start."""
    flat = poses.height_m < FLAT_HEIGHT_M
    low = poses.height_m < LOW_HEIGHT_M
    suits = np.stack(
        [
            config.table_start_weight * np.where(flat, 0.3, 1.0),
            config.edge_start_weight * np.where(flat, 1.0, np.where(low, 0.1, 0.0)),
            config.held_start_weight * np.where(flat, 1.0, 0.3),
        ],
        axis=1,
    )
    weights = (poses.weight[:, None] * suits * trust).ravel()
    if weights.sum() <= 0.0:
        raise ValueError("no kind of start is allowed for this object: raise table_start_weight above 0")
    pose, row = divmod(int(rng.choice(len(weights), p=weights / weights.sum())), len(START_KINDS))
    kind = START_KINDS[row]
    yaw = Rotation.from_euler("z", rng.uniform(0.0, 2 * np.pi)).as_matrix()
    R = yaw @ poses.R_world_from_obj[pose]
    if kind == "held":
        tilt = Rotation.from_rotvec(rng.normal(size=3) * 0.5).as_matrix()
        R = tilt @ R
    placed = poses.hull_verts_obj @ R.T
    com = R @ poses.com_obj
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = [-com[0], -com[1], -placed[:, 2].min()]
    if kind == "held":
        T[2, 3] = HELD_HEIGHT_M - com[2]
    edge = _overhang(placed[:, :2] - com[:2], rng) if kind == "edge" else None
    return Start(kind=kind, option=(pose, row), T_world_from_obj=T, table_edge=edge)


def _overhang(outline_xy: Float[np.ndarray, "vert 2"], rng: np.random.Generator) -> TableEdge:
    """A table edge across one end of the object, near enough that its weight stays on the table."""
    spread = outline_xy - outline_xy.mean(0)
    _, directions = np.linalg.eigh(spread.T @ spread)
    # Mostly along the long axis, sometimes across it.
    outward = directions[:, 1 if rng.uniform() < 0.7 else 0] * rng.choice([-1.0, 1.0])
    turn = rng.normal() * 0.15
    c, s = np.cos(turn), np.sin(turn)
    outward = np.array([[c, -s], [s, c]]) @ outward
    half = float((outline_xy @ outward).max())
    inset = max(0.006, 0.12 * half)  # of the centre of mass (the origin) behind the edge
    point = outward * min(inset, 0.8 * half)
    return TableEdge(
        point_xy_m=(float(point[0]), float(point[1])),
        outward_xy=(float(outward[0]), float(outward[1])),
    )
