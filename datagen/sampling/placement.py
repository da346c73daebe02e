"""Which part of a motion is drawn with what under it: hand posed and dressed, table or none.

Nothing may float or sink in: an object that is not yet held lies on a table, at the very height of
its lowest vertex; a table is nowhere above hand, arm or object.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, QhullError

from datagen.grasps.sequence import GraspSequence, TableEdge
from datagen.hands.arm import DressedHand, dressed_verts
from datagen.hands.model import PosedHand, pose_hand
from datagen.objects.mesh.object_mesh import ObjectMesh
from datagen.sampling.clip import ClipWindow
from datagen.sampling.errors import SamplingError
from datagen.sampling.tables import TableConfig, sample_table
from datagen.scene.scene import Table
from shards.geometry import transform_points

__all__ = ["Placement", "arm_end_verts", "object_mesh_hull", "place"]

ARM_END_M = 0.015
SINK_M = 0.003  # skin may press so far into a table: less than the eye can tell


@dataclass(frozen=True, kw_only=True)
class Placement:
    """Hand and object in the frames of a window, and the table under them. World, metres."""

    window: ClipWindow
    posed: PosedHand
    hand_verts_world: Float[np.ndarray, "frame vert 3"]  # hand, forearm and sleeve
    object_verts_world: Float[np.ndarray, "frame hull 3"]
    table: Table | None


def place(
    sequence: GraspSequence,
    windows: Iterator[ClipWindow],
    dressed: DressedHand,
    object_hull_obj: Float[np.ndarray, "hull 3"],
    config: TableConfig,
    rng: np.random.Generator,
) -> Placement:
    """The first window that works with its table. Raises SamplingError when none does."""
    wants_table = rng.uniform() < config.probability
    sunk_m = []
    for window in windows:
        posed = _pose(sequence, dressed, window)
        hand = dressed_verts(dressed, posed)
        obj = transform_points(
            sequence.T_world_from_obj[window.frames],
            np.broadcast_to(object_hull_obj, (len(window.frames), *object_hull_obj.shape)),
        )
        lowest = _lowest_over_table(np.concatenate([hand, obj], axis=1), sequence.table_edge)
        rest = float(obj[0, :, 2].min()) if window.supported else None
        if rest is not None and lowest < rest - SINK_M:
            sunk_m.append(rest - lowest)
            continue
        table = None
        if rest is not None or wants_table:
            table = _table(sequence, object_hull_obj, obj, rest, lowest, config, rng)
        return Placement(
            window=window, posed=posed, hand_verts_world=hand, object_verts_world=obj, table=table
        )
    raise SamplingError(
        f"motion {sequence.sequence_id}: in all {len(sunk_m)} windows hand or arm sink into the table, by "
        f"{min(sunk_m):.4f} m at least (allowed {SINK_M} m); "
        "shorten appearance.forearm_length_m or leave the motion out"
    )


def object_mesh_hull(mesh: ObjectMesh) -> Float[np.ndarray, "hull 3"]:
    """Vertices of the convex hull: in view, and above a plane, exactly when all vertices are."""
    used = mesh.verts_obj[np.unique(mesh.faces)]
    try:
        return used[ConvexHull(used).vertices]
    except QhullError:  # flat: every vertex counts
        return used


def arm_end_verts(
    hand_verts_world: Float[np.ndarray, "vert 3"], n_hand_verts: int, wrist_world: Float[np.ndarray, "3"]
) -> Int[np.ndarray, " end"]:
    """Vertices of the closed end of forearm or sleeve: the farthest ones along the arm."""
    arm = hand_verts_world[n_hand_verts:] - wrist_world
    axis = arm.mean(axis=0) / np.linalg.norm(arm.mean(axis=0))
    along = arm @ axis
    return n_hand_verts + np.flatnonzero(along > along.max() - ARM_END_M)


def _pose(sequence: GraspSequence, dressed: DressedHand, window: ClipWindow) -> PosedHand:
    return pose_hand(
        dressed.shaped,
        orientation_world=sequence.hand_orientation_world[window.frames],
        hand_pose=sequence.hand_pose[window.frames],
        translation_world=sequence.hand_translation_world[window.frames],
        flat_hand_mean=sequence.flat_hand_mean,
    )


def _lowest_over_table(points_world: Float[np.ndarray, "frame point 3"], edge: TableEdge | None) -> float:
    """Lowest z; with a table edge, of the points that are not beyond it."""
    if edge is None:
        return float(points_world[..., 2].min())
    behind = _behind(points_world[..., :2], edge)
    return float(np.min(points_world[..., 2], where=behind, initial=np.inf))


def _behind(points_xy: Float[np.ndarray, "*batch 2"], edge: TableEdge) -> Bool[np.ndarray, "*batch"]:
    return (points_xy - np.asarray(edge.point_xy_m)) @ np.asarray(edge.outward_xy) <= 0.0


def _table(
    sequence: GraspSequence,
    object_hull_obj: Float[np.ndarray, "hull 3"],
    object_verts_world: Float[np.ndarray, "frame hull 3"],
    rest_z_m: float | None,
    lowest_m: float,
    config: TableConfig,
    rng: np.random.Generator,
) -> Table:
    """At the object's rest height where it lay on a table and all is above it; lowered otherwise."""
    began = object_verts_world[0]
    edge = None
    top = rest_z_m
    if top is None and sequence.start != "held":
        # Held by now, over the table it was taken from.
        T = sequence.T_world_from_obj[sequence.first_drawn_frame]
        began = transform_points(T, object_hull_obj)
        top = float(began[:, 2].min())
        if lowest_m < top - SINK_M:
            top = None
    if top is None:
        top = lowest_m - rng.uniform(*config.lowered_m)
    else:
        edge = sequence.table_edge
    middle = 0.5 * (began.min(axis=0) + began.max(axis=0))[:2]
    return sample_table(
        config,
        rng,
        top_z_m=top,
        under_xy_m=(float(middle[0]), float(middle[1])),
        footprint_m=float(np.linalg.norm(began[:, :2] - middle, axis=-1).max()),
        edge=edge,
    )
