"""Change of frame rate: rotations are interpolated as rotations, never as numbers."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from datagen.grasps.sequence import GraspSequence

__all__ = ["resample_sequence"]


def resample_sequence(
    sequence: GraspSequence, fps: float, *, first_s: float | None = None, frames: int | None = None
) -> GraspSequence:
    """The motion from `first_s` seconds on (None: from its first drawn frame) at another rate.

    `frames` None: as many as the motion lasts. ValueError when it does not last that long,
    when `first_s` lies outside it, or when `fps` is not positive.
    """
    count = len(sequence.hand_pose)
    if not fps > 0.0:
        raise ValueError(f"{sequence.sequence_id}: fps is {fps}; expected a positive rate")
    begin = sequence.first_drawn_frame / sequence.fps if first_s is None else first_s
    last = (count - 1) / sequence.fps
    if not 0.0 <= begin <= last:
        raise ValueError(
            f"{sequence.sequence_id}: first_s is {begin:.3f} s; the motion lasts 0 to {last:.3f} s"
        )
    available = int(np.floor((last - begin) * fps + 1e-9)) + 1
    wanted = available if frames is None else frames
    if not 1 <= wanted <= available:
        raise ValueError(
            f"{sequence.sequence_id}: {wanted} frames at {fps:g} fps do not fit; "
            f"1 to {available} do. Raise fps or begin earlier"
        )
    at = np.clip((begin + np.arange(wanted) / fps) * sequence.fps, 0.0, count - 1.0)
    left = np.minimum(np.floor(at).astype(int), max(count - 2, 0))
    right = np.minimum(left + 1, count - 1)
    share = at - left
    R_object = _between(Rotation.from_matrix(sequence.T_world_from_obj[:, :3, :3]), left, right, share)
    T_world_from_obj = _mix(sequence.T_world_from_obj, left, right, share)
    T_world_from_obj[:, :3, :3] = R_object.as_matrix()
    pose = sequence.hand_pose.reshape(count, 15, 3)
    joints = [_between(Rotation.from_rotvec(pose[:, k]), left, right, share).as_rotvec() for k in range(15)]
    return replace(
        sequence,
        fps=fps,
        hand_orientation_world=_between(
            Rotation.from_rotvec(sequence.hand_orientation_world), left, right, share
        ).as_rotvec(),
        hand_pose=np.concatenate(joints, axis=1),
        hand_translation_world=_mix(sequence.hand_translation_world, left, right, share),
        T_world_from_obj=T_world_from_obj,
        contact_force_n=_mix(sequence.contact_force_n, left, right, share),
        grasp_frame=_same_instant(sequence.grasp_frame, sequence.fps, begin, fps),
        first_drawn_frame=_same_instant(sequence.first_drawn_frame, sequence.fps, begin, fps),
    )


def _same_instant(frame: int, old_fps: float, begin_s: float, fps: float) -> int:
    """First new frame at or after an old one; 0 when that lies before the new beginning."""
    return max(0, int(np.ceil((frame / old_fps - begin_s) * fps - 1e-6)))


def _between(
    rotations: Rotation,
    left: Int[np.ndarray, " new"],
    right: Int[np.ndarray, " new"],
    share: Float[np.ndarray, " new"],
) -> Rotation:
    """Spherical interpolation along the shorter way."""
    step = (rotations[left].inv() * rotations[right]).as_rotvec()
    return rotations[left] * Rotation.from_rotvec(share[:, None] * step)


def _mix(
    values: Float[np.ndarray, " old *rest"],
    left: Int[np.ndarray, " new"],
    right: Int[np.ndarray, " new"],
    share: Float[np.ndarray, " new"],
) -> Float[np.ndarray, " new *rest"]:
    weight = share.reshape(-1, *[1] * (values.ndim - 1))
    return (1.0 - weight) * values[left] + weight * values[right]
