"""The motion that a line of the plan asks for: simulated or recorded, right- or left-handed."""

import numpy as np

from datagen.config import DatasetConfig
from datagen.grasps.mirror import mirrored_sequence
from datagen.grasps.recorded.graspxl import read_sequence, sequence_file
from datagen.grasps.recorded.replay import replay
from datagen.grasps.sequence import GraspSequence
from datagen.grasps.synthesis.synthesise import synthesise_grasp
from datagen.hands.model import HandModel, shape_hand
from datagen.input_error import InputError
from datagen.objects.asset.mirror import is_mirrored, mirrored_asset, unmirrored_uid
from datagen.objects.asset.object_asset import ObjectAsset
from datagen.objects.errors import ObjectError
from datagen.plan.plan import MotionPlan
from datagen.sampling.appearance import sample_betas
from datagen.sampling.streams import Stream, stream_rng
from datagen.sources.motions import graspxl_root
from datagen.sources.objects import open_library

__all__ = ["NoGraspError", "UnusableObjectError", "drawn_sequence", "load_object"]


class NoGraspError(ValueError):
    """No attempt at this motion was worth keeping; the message counts the reasons."""


class UnusableObjectError(ValueError):
    """An object that passed the selection cannot be prepared: no closed version of it could be made."""


def load_object(config: DatasetConfig, motion: MotionPlan) -> ObjectAsset:
    """The object as it is drawn.

    ObjectError where this machine lacks the file or reads it otherwise than the selection did.
    UnusableObjectError (only with `selection.unusable: remove`) where it reads well, but no watertight mesh
    can be made of it, which the selection does not try. InputError where licence or appearance
    are not those that were planned.
    """
    library, uid = open_library(config.objects, config.motions), unmirrored_uid(motion.object_uid)
    try:
        asset = library.load(uid)
    except ObjectError as error:
        if config.selection.unusable == "stop":
            raise
        library.measure(uid)
        raise UnusableObjectError(str(error)) from error
    if (asset.licence, asset.appearance) != (motion.licence, motion.appearance):
        raise InputError(
            motion.object_uid,
            f"is drawn here as {asset.appearance} under {asset.licence}",
            expected=f"{motion.appearance} under {motion.licence}, as it was planned and allowed",
            action="Give this machine the same object store and metadata, or plan anew into another --out.",
        )
    return mirrored_asset(asset) if is_mirrored(motion.object_uid) else asset


def drawn_sequence(
    config: DatasetConfig, motion: MotionPlan, right_hand: HandModel, asset: ObjectAsset
) -> GraspSequence:
    """The motion of a hand and `asset` (see `load_object`).

    A left hand is always the mirror image of a right one. A recorded motion is replayed with the
    object as it was recorded, then mirrored together with it; a simulated one is simulated with the
    mirror image of the object, so that the mirrored motion fits the object itself. Raises
    NoGraspError, ReplayError, InputError.
    """
    is_left = motion.hand_side == "left"
    recorded_with = mirrored_asset(asset) if is_left else asset
    made = _recorded if motion.sequence_id else _simulated
    sequence = made(config, motion, right_hand, recorded_with)
    return mirrored_sequence(sequence, asset.uid) if is_left else sequence


def _simulated(
    config: DatasetConfig, motion: MotionPlan, right_hand: HandModel, asset: ObjectAsset
) -> GraspSequence:
    seed, index = config.seed, motion.motion_index
    betas = sample_betas(stream_rng(seed, index, Stream.HAND_SHAPE), config.sampling.appearance)
    hand = shape_hand(right_hand, betas)
    found = synthesise_grasp(hand, asset, config.grasp, stream_rng(seed, index, Stream.GRASP))
    if found.sequence is None:
        reasons = ", ".join(f"{reason} {count}" for reason, count in found.failure_counts().items())
        raise NoGraspError(f"no grasp kept for {asset.uid} in {found.attempts} attempts ({reasons})")
    return found.sequence


def _recorded(
    config: DatasetConfig, motion: MotionPlan, right_hand: HandModel, asset: ObjectAsset
) -> GraspSequence:
    file = sequence_file(graspxl_root(config.motions.graspxl_root), motion.sequence_id)
    # GraspXL recorded with betas 0; another shape would not touch the object.
    hand = shape_hand(right_hand, np.zeros(right_hand.shapedirs.shape[2]))
    return replay(read_sequence(file), hand, asset, config.motions.replay)
