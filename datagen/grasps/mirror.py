"""The mirror image of a motion: a right hand becomes a left one. Mirror: x -> -x of the world."""

from dataclasses import replace
from typing import Literal

import numpy as np

from datagen.grasps.sequence import GraspSequence, TableEdge
from datagen.hands.model import mirror_axis_angle

__all__ = ["mirrored_sequence"]

_FLIP = np.diag([-1.0, 1.0, 1.0, 1.0])


def mirrored_sequence(sequence: GraspSequence, object_uid: str) -> GraspSequence:
    """The motion in the mirror, for the mirrored hand and the mirrored object, which is `object_uid`.

    Posed vertices of `mirror_hand` and the mirrored mesh are the mirror images of the original's.
    """
    side: Literal["right", "left"] = "left" if sequence.side == "right" else "right"
    edge = sequence.table_edge
    return replace(
        sequence,
        object_uid=object_uid,
        side=side,
        hand_orientation_world=mirror_axis_angle(sequence.hand_orientation_world),
        hand_pose=mirror_axis_angle(sequence.hand_pose.reshape(-1, 15, 3)).reshape(-1, 45),
        hand_translation_world=sequence.hand_translation_world * np.array([-1.0, 1.0, 1.0]),
        T_world_from_obj=_FLIP @ sequence.T_world_from_obj @ _FLIP,
        table_edge=None
        if edge is None
        else TableEdge(
            point_xy_m=(-edge.point_xy_m[0], edge.point_xy_m[1]),
            outward_xy=(-edge.outward_xy[0], edge.outward_xy[1]),
        ),
    )
