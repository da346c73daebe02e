"""Simulated motions of left hands, and objects that turn out to be unusable."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from datagen.config import load_config
from datagen.grasps.contact import digit_distances, signed_distances
from datagen.grasps.object_surface import ObjectSurface
from datagen.hands.model import pose_hand, shape_hand
from datagen.jobs.planned_motion import UnusableObjectError, drawn_sequence, load_object
from datagen.objects.errors import ObjectError
from datagen.plan.plan import MotionPlan
from datagen.sources.hands import open_hand
from tests.datagen.jobs.test_render_shard import small_config


def line(uid: str, *, side: str = "right", sequence_id: str = "") -> MotionPlan:
    return MotionPlan(
        motion_index=0,
        motion_id="motion-000000",
        shard=0,
        object_uid=uid,
        sequence_id=sequence_id,
        hand_side=side,
        licence="NOASSERTION",
        appearance="original",
        split="train",
        n_cameras=1,
        n_frames=2,
        cost_megapixel_samples=0.0,
    )


def test_a_simulated_left_hand_grasps_the_object_itself(tmp_path: Path):
    """Simulated with the mirrored object, mirrored back: the left hand touches the real mesh."""
    config = load_config(small_config(tmp_path))
    wedge = trimesh.Trimesh(  # no mirror symmetry in any plane
        [[0.0, 0.0, 0.0], [0.09, 0.0, 0.0], [0.0, 0.05, 0.0], [0.02, 0.03, 0.12]],
        [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]],
    )
    wedge.export(tmp_path / "meshes" / "wedge.ply")
    motion = line("folder/wedge", side="left")
    asset = load_object(config, motion)
    source = open_hand(config.hand)
    sequence = drawn_sequence(config, motion, source.right, asset)
    assert (sequence.side, sequence.object_uid) == ("left", asset.uid)
    hand = shape_hand(source.model("left"), sequence.betas)
    rows = np.linspace(sequence.grasp_frame, len(sequence.hand_pose) - 1, 9).astype(int)
    posed = pose_hand(
        hand,
        orientation_world=sequence.hand_orientation_world[rows],
        hand_pose=sequence.hand_pose[rows],
        translation_world=sequence.hand_translation_world[rows],
        flat_hand_mean=sequence.flat_hand_mean,
    )
    surface = ObjectSurface(asset)
    distances = signed_distances(surface, posed.verts_world, sequence.T_world_from_obj[rows])
    digits = np.median(digit_distances(hand.model, distances), axis=0)
    np.testing.assert_allclose(digits, sequence.quality.digit_distance_m, atol=2e-3)
    assert (digits < 0.003).sum() >= 3
    assert -distances.min() <= sequence.quality.max_penetration_m + 1e-3


def test_an_object_without_a_watertight_stops_or_is_left_out_as_the_configuration_says(tmp_path, monkeypatch):
    path = small_config(tmp_path)
    config = load_config(path)
    stopping = replace(config, selection=replace(config.selection, unusable="stop"))

    def no_watertight(self, uid):
        raise ObjectError(uid, "encloses no volume", expected="some thickness", action="Give it one.")

    library = "datagen.objects.stores.folder.MeshFolder.load"
    monkeypatch.setattr(library, no_watertight)
    with pytest.raises(ObjectError, match="encloses no volume"):
        load_object(stopping, line("folder/can"))
    with pytest.raises(UnusableObjectError, match="encloses no volume"):
        load_object(config, line("folder/can"))
    (tmp_path / "meshes" / "can.ply").unlink()  # a file that is missing here is never "left out"
    with pytest.raises(ObjectError) as error:
        load_object(config, line("folder/can"))
    assert not isinstance(error.value, UnusableObjectError)
