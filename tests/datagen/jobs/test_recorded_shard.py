"""Recorded motions with MANO, HTML skin and Objaverse textures through the whole generator, right and left."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from datagen.cli.main import main
from datagen.config import load_config
from datagen.hands.mano import load_mano
from datagen.hands.model import HandModel, load_open_hand, pose_hand, shape_hand
from shards.reader import Dataset
from shards.verify import verify_dataset
from tests.datagen.grasps.recorded.graspxl_sample import SAMPLE, needs_sample
from tests.datagen.hands.official_files import uncapped, write_html, write_mano
from tests.datagen.jobs.test_render_shard import rendered
from tests.datagen.licensed_config import IDS, write_config, write_grasped_motion
from tests.datagen.objects.official_files import write_graspxl_objects, write_objaverse_store

pytestmark = pytest.mark.blender
BREAD = IDS[0]
MANO_WRIST_REST = np.array([0.09566994, 0.00638343, 0.0061863])  # FORMATS 2.2
FLIP = np.array([-1.0, 1.0, 1.0])
POSE_COLUMNS = [
    "hand_orientation_world",
    "hand_pose",
    "hand_translation_world",
    "joints_world",
    "T_world_from_obj",
]


def small(config: dict[str, Any]) -> None:
    config["plan"] = {"motions": 1, "motions_per_shard": 1}
    config["sampling"]["clip"]["n_frames"] = 3
    config["sampling"]["cameras"] |= {"n_cameras": 1, "image_size": [48, 48]}
    config["sampling"]["render"] |= {"samples": 2, "max_bounces": 1, "denoise": False}
    config["targets"] |= {"surface_points": 256, "sdf_near_points": 256, "sdf_uniform_points": 128}


def _with_mano_wrist() -> HandModel:
    """The open hand moved to where MANO's rest wrist is: a stand-in is placed by that."""
    model = uncapped(load_open_hand())
    wrist = model.J_regressor[0] @ model.v_template
    return replace(model, v_template=model.v_template + MANO_WRIST_REST - wrist)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Path:
    """Everything licensed, generated in its published layout; one motion that MANO really grasps in."""
    folder = tmp_path_factory.mktemp("inputs")
    write_mano(folder / "hands", model=_with_mano_wrist())
    write_html(folder / "hands")
    write_graspxl_objects(folder / "graspxl")
    write_objaverse_store(folder / "store")
    grasp = load_config(write_config(folder)).grasp
    write_grasped_motion(folder, load_mano(folder / "hands", "right"), BREAD, grasp)
    return folder


def render(inputs: Path, out: Path, **hand: object) -> Dataset:
    def change(config: dict[str, Any]) -> None:
        small(config)
        places = {"mano_dir": str(inputs / "hands"), "html_dir": str(inputs / "hands")}
        config["hand"] |= {"model": "auto", "skin": "auto", "left_probability": 0.0, **places, **hand}

    return rendered(write_config(inputs, change), out)


@pytest.fixture(scope="module")
def right(inputs, tmp_path_factory) -> Dataset:
    return render(inputs, tmp_path_factory.mktemp("right"))


def test_the_shard_says_what_it_was_made_of(right, inputs):
    (clip,) = right.clips()
    assert (clip.hand_model, clip.hand_side, clip.hand_stands_in_for) == ("mano", "right", "")
    assert clip.skin_model == "html model_sr"
    assert (clip.grasp_source, clip.grasp_licence) == ("graspxl", "CC-BY-NC-4.0")
    assert clip.grasp_sequence_id == f"mano_dataset_1/large/{BREAD}/mano_1"
    assert np.isfinite(clip.digit_distance_m).all()
    assert (clip.digit_distance_m < 0.005).sum() >= 3
    assert np.all(clip.betas == 0.0)
    (row,) = right.objects()
    assert row.object_uid == clip.object_uid == f"objaverse/{BREAD}@large"
    assert (row.licence, row.author) == ("CC-BY-4.0", "Ann Modeller")
    assert 0.0 <= row.registration_residual < 0.02
    assert row.mesh_glb is not None  # CC-BY may be handed on
    (report,) = verify_dataset(right.path)
    assert report.ok, report.findings


def test_stored_parameters_pose_the_mano_file_to_the_stored_joints(right, inputs):
    (clip,) = right.clips()
    frames = right.read_frames(clip.clip_id, POSE_COLUMNS)
    posed = pose_hand(
        shape_hand(load_mano(inputs / "hands", "right"), clip.betas.astype(np.float64)),
        orientation_world=frames["hand_orientation_world"].astype(np.float64),
        hand_pose=frames["hand_pose"].astype(np.float64),
        translation_world=frames["hand_translation_world"].astype(np.float64),
        flat_hand_mean=clip.flat_hand_mean,
    )
    np.testing.assert_allclose(posed.joints_world, frames["joints_world"], atol=2e-6)


def test_a_left_hand_is_the_mirrored_motion_of_the_mirrored_object(right, inputs, tmp_path):
    left = render(inputs, tmp_path, left_probability=1.0)
    (a,), (b,) = right.clips(), left.clips()
    assert (b.hand_side, b.object_uid) == ("left", f"{a.object_uid}-mirrored")
    assert b.split == a.split
    frames_a, frames_b = (d.read_frames(c.clip_id, POSE_COLUMNS) for d, c in ((right, a), (left, b)))
    np.testing.assert_allclose(frames_b["joints_world"], frames_a["joints_world"] * FLIP, atol=2e-6)
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(
        frames_b["T_world_from_obj"], mirror @ frames_a["T_world_from_obj"] @ mirror, atol=1e-9
    )
    (row_a,), (row_b,) = right.objects(), left.objects()
    np.testing.assert_allclose(
        row_b.surface_points.mean(axis=0), row_a.surface_points.mean(axis=0) * FLIP, atol=0.02
    )
    (report,) = verify_dataset(left.path)
    assert report.ok, report.findings


def test_without_mano_the_open_hand_stands_in_and_every_clip_says_so(inputs, tmp_path):
    (clip,) = render(inputs, tmp_path, mano_dir=None).clips()
    assert (clip.hand_model, clip.hand_stands_in_for, clip.skin_model) == ("openhand", "mano", "open")


def test_mano_that_appears_after_planning_does_not_change_hands_within_a_dataset(
    inputs, tmp_path, monkeypatch
):
    def change(config: dict[str, Any]) -> None:
        small(config)
        config["hand"] |= {"model": "auto", "skin": "open"}

    monkeypatch.delenv("MANO_DIR", raising=False)
    path = write_config(inputs, change)
    plan = ["plan", "--config", str(path), "--out", str(tmp_path / "out")]
    assert CliRunner().invoke(main, plan).exit_code == 0
    monkeypatch.setenv("MANO_DIR", str(inputs / "hands"))
    result = CliRunner().invoke(main, plan)
    assert result.exit_code == 2
    assert "another configuration" in result.output


def test_a_store_that_changes_after_planning_is_refused_not_drawn(inputs, tmp_path):
    """A licence that the selection never allowed must not come in through the worker."""
    shutil.copytree(inputs, tmp_path / "inputs")
    own = tmp_path / "inputs"

    def change(config: dict[str, Any]) -> None:
        small(config)
        config["objects"]["textures"] = "when_present"

    path = write_config(own, change)
    glbs, hidden = own / "store" / "glbs", own / "hidden"
    metadata = own / "store" / "metadata"
    shutil.move(glbs, hidden)
    metadata.rename(own / "metadata")
    plan = ["plan", "--config", str(path), "--out", str(tmp_path / "out")]
    assert CliRunner().invoke(main, plan).exit_code == 0
    shutil.move(hidden, glbs)
    (own / "metadata").rename(metadata)
    result = CliRunner().invoke(main, ["render", *plan[1:], "--shard", "0"])
    assert result.exit_code == 2
    assert "is drawn here as original under CC-BY-4.0; expected generated under CC-BY-NC-4.0" in result.output


def test_a_takedown_after_planning_skips_what_waits_and_names_what_is_finished(inputs, tmp_path):
    shutil.copytree(inputs, tmp_path / "inputs")
    own = tmp_path / "inputs"
    (own / "takedown.txt").write_text("")

    def change(config: dict[str, Any]) -> None:
        small(config)
        config["selection"]["takedown"] = "takedown.txt"

    path = write_config(own, change)
    arguments = ["--config", str(path), "--out", str(tmp_path / "out")]
    assert CliRunner().invoke(main, ["plan", *arguments]).exit_code == 0
    (own / "takedown.txt").write_text(f"https://sketchfab.com/3d-models/bread-{BREAD.upper()}\n")
    result = CliRunner().invoke(main, ["render", *arguments, "--shard", "0"])
    assert result.exit_code == 0, result.output
    (report,) = verify_dataset(tmp_path / "out")
    assert report.skipped == (f"motion 0: on the takedown list as {BREAD}",)
    finished = tmp_path / "finished"
    (own / "takedown.txt").write_text("")
    rendered(path, finished)
    (own / "takedown.txt").write_text(BREAD)
    result = CliRunner().invoke(
        main, ["render", "--config", str(path), "--out", str(finished), "--shard", "0"]
    )
    assert result.exit_code == 2
    assert "is finished and holds 1 motions of what the takedown list names" in result.output


@needs_sample
def test_the_real_sample_renders_into_a_verified_shard(tmp_path):
    def change(config: dict[str, Any]) -> None:
        small(config)
        config["motions"]["graspxl_root"] = str(SAMPLE)
        config["objects"]["textures"] = "none"

    dataset = rendered(write_config(tmp_path, change), tmp_path / "out")
    (report,) = verify_dataset(dataset.path)
    assert report.ok, report.findings
    assert report.skipped == ()
    (clip,) = dataset.clips()
    assert (clip.hand_stands_in_for, clip.object_uid[:10]) == ("mano", "objaverse/")


@needs_sample
@pytest.mark.slow
def test_all_twenty_objects_of_the_sample_render_into_one_verified_shard(tmp_path):
    def change(config: dict[str, Any]) -> None:
        small(config)
        config["plan"] = {"motions": 20, "motions_per_shard": 20}
        config["motions"]["graspxl_root"] = str(SAMPLE)
        config["objects"]["textures"] = "none"

    dataset = rendered(write_config(tmp_path, change), tmp_path / "out")
    (report,) = verify_dataset(dataset.path)
    assert report.ok, report.findings
    assert report.skipped == ()
    assert len({clip.object_uid.partition("@")[0] for clip in dataset.clips()}) == 20
