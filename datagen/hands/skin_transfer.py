"""Lays the texture of one hand model on another of the same layout but any mesh.

The source's rest mesh is brought to the target's proportions bone by bone; each target triangle then
looks for the source triangle it lies on, and each of its corners for the closest point on the skin
around that triangle. "Around" goes along the texture, never across one of its seams, so no triangle
spans a seam and no coordinate leaves the painted area.
"""

from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array, csr_array
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from datagen.hands.arm import wrist_cap
from datagen.hands.model import HandModel
from shards.joints import DIGIT_JOINTS, DIGITS

__all__ = ["transferred_corner_uv"]

_NORMAL_M = 0.015  # opposite sides of a finger count as this much further apart, twice
_N_CLOSEST = 8  # triangles, by their centres, on which the closest point is sought
_MAX_RINGS = 6
_TIE = 1e-6  # of a squared distance from the start: micrometres
_PALM = [0, *(DIGIT_JOINTS[digit][0] for digit in DIGITS)]


def transferred_corner_uv(source: HandModel, target: HandModel) -> Float[np.ndarray, "face 3 2"]:
    """UV of every corner of the target's faces in the source's texture layout.

    Looks at rest shapes, skinning weights and tips, not at `target.corner_uv`. The cap behind the
    source's wrist ring gives no texture. ValueError when one hand is a right and one a left one.
    """
    if source.side != target.side:
        raise ValueError(f"cannot lay the skin of a {source.side} hand on a {target.side} hand")
    skin = ~wrist_cap(source.faces, source.wrist_loop)
    faces, corner_uv = source.faces[skin], source.corner_uv[skin]
    triangles = _verts_in_proportions_of(source, target)[faces]
    wanted = target.v_template[target.faces]
    start = _face_below(triangles, _face_part(source, faces), wanted, _face_part(target, target.faces))
    around = _faces_around(faces, corner_uv, _rings_needed(triangles, wanted))
    face, barycentric = _closest_points(triangles, around, start, wanted)
    return np.einsum("fck,fckd->fcd", barycentric, corner_uv[face])


def _rest_joints(model: HandModel) -> Float[np.ndarray, "21 3"]:
    return np.concatenate([model.J_regressor @ model.v_template, model.v_template[model.tip_ids]])


def _verts_in_proportions_of(source: HandModel, target: HandModel) -> Float[np.ndarray, "vert 3"]:
    """The source's rest mesh skinned with one similarity per bone that lays its joints on the target's."""
    joints, goals = _rest_joints(source), _rest_joints(target)
    moves = np.empty((16, 3, 4))
    moves[0] = _similarity(joints[_PALM], goals[_PALM])
    for d, digit in enumerate(DIGITS):
        chain = [*DIGIT_JOINTS[digit], 16 + d]
        for joint, child in pairwise(chain):
            moves[joint] = _bone_similarity(joints[[joint, child]], goals[[joint, child]])
    homogeneous = np.concatenate([source.v_template, np.ones((len(source.v_template), 1))], axis=1)
    return np.einsum("vj,jab,vb->va", source.weights, moves, homogeneous, optimize=True)


def _similarity(
    points: Float[np.ndarray, "n 3"], goals: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "3 4"]:
    """Least-squares [s R | t] with s R p + t = goal (Umeyama 1991)."""
    center, goal_center = points.mean(axis=0), goals.mean(axis=0)
    rotation = Rotation.align_vectors(goals - goal_center, points - center)[0].as_matrix()
    scale = np.sqrt(((goals - goal_center) ** 2).sum() / ((points - center) ** 2).sum())
    return np.column_stack([scale * rotation, goal_center - scale * rotation @ center])


def _bone_similarity(
    bone: Float[np.ndarray, "2 3"], goal: Float[np.ndarray, "2 3"]
) -> Float[np.ndarray, "3 4"]:
    """Moves a bone (its two ends) onto another one, turning it no more than needed."""
    along, goal_along = bone[1] - bone[0], goal[1] - goal[0]
    scale = np.linalg.norm(goal_along) / np.linalg.norm(along)
    axis = np.cross(along, goal_along)
    angle = np.arctan2(np.linalg.norm(axis), along @ goal_along)
    unit = axis / max(float(np.linalg.norm(axis)), 1e-12)
    rotation = Rotation.from_rotvec(angle * unit).as_matrix()
    return np.column_stack([scale * rotation, goal[0] - scale * rotation @ bone[0]])


def _face_part(model: HandModel, faces: Int[np.ndarray, "face 3"]) -> Int[np.ndarray, " face"]:
    """What moves each face most: 0 the palm, 1 .. 5 the digits."""
    weights = model.weights[faces].sum(axis=1)
    digits = [weights[:, list(DIGIT_JOINTS[digit])].sum(axis=1) for digit in DIGITS]
    return np.argmax(np.stack([weights[:, 0], *digits], axis=1), axis=1)


def _face_below(
    triangles: Float[np.ndarray, "face 3 3"],
    part: Int[np.ndarray, " face"],
    wanted: Float[np.ndarray, "target 3 3"],
    wanted_part: Int[np.ndarray, " target"],
) -> Int[np.ndarray, " target"]:
    """The source face on which each target face lies: near, facing the same way, of no other digit."""
    features, wanted_features = _features(triangles), _features(wanted)
    found = np.empty(len(wanted), dtype=np.int64)
    for number in range(len(DIGITS) + 1):
        rows = np.flatnonzero(wanted_part == number)
        # Models disagree on where a digit begins, so palm and digit may serve each other.
        allowed = np.flatnonzero((part == number) | (part == 0)) if number else np.arange(len(part))
        if len(rows):
            found[rows] = allowed[cKDTree(features[allowed]).query(wanted_features[rows])[1]]
    return found


def _features(triangles: Float[np.ndarray, "face 3 3"]) -> Float[np.ndarray, "face 6"]:
    """Centre of each triangle in metres, and its normal in lengths that compare with metres."""
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return np.concatenate([triangles.mean(axis=1), _NORMAL_M * normal], axis=1)


def _rings_needed(triangles: Float[np.ndarray, "face 3 3"], wanted: Float[np.ndarray, "target 3 3"]) -> int:
    """How many rings of source faces reach from the middle of a target face beyond its corners."""
    reach = np.linalg.norm(wanted - wanted.mean(axis=1, keepdims=True), axis=-1).max(axis=1)
    edge = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=-1)
    return int(np.clip(np.ceil(np.percentile(reach, 95) / np.median(edge)) + 1, 2, _MAX_RINGS))


def _faces_around(
    faces: Int[np.ndarray, "face 3"], corner_uv: Float[np.ndarray, "face 3 2"], n_rings: int
) -> Int[np.ndarray, "face around"]:
    """Faces reached from each face over shared vertices that have one UV (-1: no more)."""
    keys = np.concatenate([faces.reshape(-1, 1), np.rint(corner_uv.reshape(-1, 2) * 2**20)], axis=1)
    place = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
    ones = np.ones(len(place), dtype=np.int32)
    at: csr_array = coo_array((ones, (np.repeat(np.arange(len(faces)), 3), place))).tocsr()
    step = reached = _connected(at @ at.T)
    for _ in range(n_rings - 1):
        reached = _connected(reached @ step)
    counts = np.diff(reached.indptr)
    around = np.full((len(faces), counts.max()), -1, dtype=np.int64)
    around[np.arange(counts.max()) < counts[:, None]] = reached.indices
    return around


def _connected(counts: csr_array) -> csr_array:
    """Ones where there is any count, so that powers do not overflow."""
    return csr_array(
        (np.ones(len(counts.indices), dtype=np.int32), counts.indices, counts.indptr), counts.shape
    )


def _closest_points(
    triangles: Float[np.ndarray, "face 3 3"],
    around: Int[np.ndarray, "face around"],
    start: Int[np.ndarray, " target"],
    wanted: Float[np.ndarray, "target 3 3"],
) -> tuple[Int[np.ndarray, "target 3"], Float[np.ndarray, "target 3 3"]]:
    """Source face and barycentric coordinates of the point next to each target corner."""
    candidates = around[start]
    centers = triangles.mean(axis=1)[candidates]
    squared = ((wanted[:, :, None] - centers[:, None]) ** 2).sum(axis=-1)
    squared[np.broadcast_to((candidates < 0)[:, None], squared.shape)] = np.inf
    n_closest = min(_N_CLOSEST, candidates.shape[1])
    near = np.argpartition(squared, n_closest - 1, axis=-1)[..., :n_closest]
    face = np.take_along_axis(candidates[:, None], near, axis=-1)
    face = np.where(face < 0, start[:, None, None], face)
    barycentric, distance = _closest_on_triangles(wanted[:, :, None], triangles[face])
    # On a seam two faces are equally close, with different coordinates: the one next to the start wins.
    from_start = ((triangles[face].mean(axis=-2) - triangles[start].mean(axis=1)[:, None, None]) ** 2).sum(
        axis=-1
    )
    best = (distance + _TIE * from_start).argmin(axis=-1)[..., None]
    return (
        np.take_along_axis(face, best, axis=-1)[..., 0],
        np.take_along_axis(barycentric, best[..., None], axis=-2)[..., 0, :],
    )


def _closest_on_triangles(
    points: Float[np.ndarray, "*#batch 3"], triangles: Float[np.ndarray, "*batch 3 3"]
) -> tuple[Float[np.ndarray, "*batch 3"], Float[np.ndarray, "*batch"]]:
    """Barycentric coordinates of the closest point of each triangle, and its squared distance."""
    a, b, c = np.moveaxis(triangles, -2, 0)
    plane = _plane_coordinates(points - a, b - a, c - a)
    zero = np.zeros(plane.shape[:-1])
    ab, bc, ca = _along(points, a, b), _along(points, b, c), _along(points, c, a)
    options = np.stack(
        [
            plane,
            np.stack([1.0 - ab, ab, zero], axis=-1),
            np.stack([zero, 1.0 - bc, bc], axis=-1),
            np.stack([ca, zero, 1.0 - ca], axis=-1),
        ]
    )
    squared = ((np.einsum("o...k,...kd->o...d", options, triangles) - points) ** 2).sum(axis=-1)
    squared[0][_outside(plane)] = np.inf
    best = squared.argmin(axis=0)[None]
    return (
        np.take_along_axis(options, best[..., None], axis=0)[0],
        np.take_along_axis(squared, best, axis=0)[0],
    )


def _plane_coordinates(
    point: Float[np.ndarray, "*batch 3"], u: Float[np.ndarray, "*batch 3"], v: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """Barycentric coordinates of the foot of the perpendicular; edges u and v leave the first corner."""
    uu, uv, vv = (u * u).sum(axis=-1), (u * v).sum(axis=-1), (v * v).sum(axis=-1)
    pu, pv = (point * u).sum(axis=-1), (point * v).sum(axis=-1)
    determinant = np.maximum(uu * vv - uv * uv, 1e-30)
    second, third = (vv * pu - uv * pv) / determinant, (uu * pv - uv * pu) / determinant
    return np.stack([1.0 - second - third, second, third], axis=-1)


def _along(
    points: Float[np.ndarray, "*#batch 3"],
    start: Float[np.ndarray, "*batch 3"],
    end: Float[np.ndarray, "*batch 3"],
) -> Float[np.ndarray, "*batch"]:
    """Where on an edge the closest point lies, 0 .. 1."""
    edge = end - start
    length = np.maximum((edge**2).sum(axis=-1), 1e-30)
    return np.clip(((points - start) * edge).sum(axis=-1) / length, 0.0, 1.0)


def _outside(barycentric: Float[np.ndarray, "*batch 3"]) -> Bool[np.ndarray, "*batch"]:
    return (barycentric < 0.0).any(axis=-1)
