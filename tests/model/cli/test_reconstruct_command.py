"""`forehoi reconstruct` with real small networks: what it writes, that it repeats, and what stops it."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from model.inference.record import RECORD
from model.video.frames import ReadLimits
from model.video.reading import read_frames
from model.video.staged_folder import MANIFEST
from shards.reader import find_clip, open_shards
from tests.model.inference.small_networks import change_last_bias
from tests.model.small_run import fails, forehoi
from tests.model.video.encoded_videos import numbered_video


def command(runs, *arguments: object) -> list[object]:
    return ["reconstruct", *arguments, "--stage-one", runs.one, "--stage-two", runs.two]


def record_of(folder: Path) -> dict:
    return json.loads((folder / RECORD).read_text())


def files_of(folder: Path) -> dict[str, bytes]:
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def refused(runs, tmp_path: Path, *arguments: object) -> str:
    """The one line of a command that fails and leaves nothing behind, not even half a folder."""
    out = tmp_path / "new" / "out"
    text = fails(*command(runs, *arguments, "--out", out))
    assert not out.parent.exists()
    return text


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    return numbered_video(tmp_path_factory.mktemp("videos") / "in.mp4", 12)


@pytest.fixture(scope="module")
def finished(runs, video, tmp_path_factory) -> Path:
    """The result of two frames of a video. Do not change it."""
    out = tmp_path_factory.mktemp("results") / "first"
    status, output = forehoi(*command(runs, video, "--out", out, "--count", 2))
    assert status == 0, output
    assert "stage 2: structured latents" in output
    assert "contact_sheet.png" in output
    return out


def test_everything_is_written(finished, video):
    record = record_of(finished)
    assert record["input"] == {"source": str(video), "kind": "video", "frames_in_source": 12, "changes": []}
    frames = record["frames"]
    assert len(frames) == 2
    masks = [f"masks/{frame['index']:06d}.png" for frame in frames]
    plain = ("object.glb", "voxels.ply", "turntable.mp4", "contact_sheet.png", RECORD, MANIFEST)
    assert sorted(files_of(finished)) == sorted([*masks, *plain])
    for frame, name in zip(frames, masks):
        assert frame["source_size_px"] == [160, 96]
        assert 0 <= frame["choice"]["sharpness"] <= 1
        assert frame["crop"]["side_px"] > 0
        with Image.open(finished / name) as mask:
            assert (mask.size, mask.mode) == ((160, 96), "L")
            assert set(np.unique(np.asarray(mask))) <= {0, 255}
    assert [c["component"] for c in record["checkpoints"]] == ["vae", "stage_one", "slat_vae", "slat_flow"]
    assert all(len(c["weights_sha256"]) == 64 and c["step"] == c["steps"] == 2 for c in record["checkpoints"])
    assert {"read frames", "load networks", "stage 1: masks and voxels", "mesh"} <= set(record["seconds"])
    assert record["scale"]["metres_per_unit"] is None
    assert record["metrics"] is None  # nobody knows the truth of a video
    assert record["seed"] == 0


def test_the_mesh_is_watertight_and_the_voxels_are_counted(finished):
    record = record_of(finished)
    (mesh,) = trimesh.load_scene(finished / "object.glb").geometry.values()
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert len(mesh.faces) == record["surface"]["faces"]
    np.testing.assert_allclose(mesh.extents[[0, 2, 1]], record["surface"]["bounding_box_sides"], atol=1e-3)
    voxels = trimesh.load_mesh(finished / "voxels.ply")
    assert np.abs(voxels.vertices).max() <= 0.5
    assert record["voxels"]["occupied"] > 0
    turn = read_frames(finished / "turntable.mp4", ReadLimits(max_frames=100, max_side_px=64))
    assert len(turn) == 36


def test_a_seed_repeats_every_byte_and_overwriting_is_asked_for(runs, video, finished, tmp_path):
    out = tmp_path / "again"
    again = command(runs, video, "--out", out)  # 2 frames: as stage 1 was validated with
    assert forehoi(*again)[0] == 0
    first, second = files_of(finished), files_of(out)
    timed = {RECORD, MANIFEST}
    assert {k: v for k, v in first.items() if k not in timed} == {
        k: v for k, v in second.items() if k not in timed
    }
    assert "--overwrite" in fails(*again)
    assert files_of(out) == second
    status, output = forehoi(*again, "--overwrite", "--seed", 7, "--stages", "one")
    assert status == 0, output
    assert record_of(out)["seed"] == 7
    assert record_of(out)["surface"] is None
    assert "object.glb" not in files_of(out)
    assert any("stage 1 only" in note for note in record_of(out)["notes"])
    (out / "mine.txt").write_text("kept")
    assert "mine.txt" in fails(*again, "--overwrite")


def test_a_clip_that_was_held_out_frames_by_number_and_a_box(runs, tmp_path):
    out = tmp_path / "out"
    choice = ("--frames", "3,0", "--box", "5,5,35,35", "--stages", "one")
    status, output = forehoi(*command(runs, "--held-out", "--out", out, *choice))
    assert status == 0, output
    record = record_of(out)
    # 40 % of three cameras, the last ones, are held out.
    assert record["input"]["source"] == f"{runs.dataset}#motion-000000-camera-01"
    assert [(frame["index"], frame["choice"]) for frame in record["frames"]] == [(0, None), (3, None)]
    assert {frame["crop"]["origin"] for frame in record["frames"]} <= {"given box", "predicted masks"}
    assert record["scale"]["metres_per_unit"] > 0
    assert "not the images" in record["scale"]["metres_from"]


def test_a_clip_is_compared_with_its_true_surface(runs, tmp_path):
    """The printed metrics once more: from object.glb as others read it, and nearest neighbours by brute force."""
    out = tmp_path / "out"
    status, output = forehoi(*command(runs, "--held-out", "--out", out, "--count", 2))
    assert status == 0, output
    metrics = record_of(out)["metrics"]
    assert f"chamfer {metrics['chamfer_cm']:.2f} cm" in output

    clip_id = record_of(out)["input"]["source"].partition("#")[2]
    shard = find_clip(open_shards(str(runs.dataset)), clip_id, where=str(runs.dataset))
    uid = shard.read_clip(clip_id).object_uid
    truth = shard.read_object(uid, ("surface_points", "object_scale_m"))
    scale = float(truth["object_scale_m"][0])
    (mesh,) = trimesh.load_scene(out / "object.glb").geometry.values()
    found_y_up, _ = trimesh.sample.sample_surface(mesh, 30_000, seed=1)
    found = found_y_up @ [[1, 0, 0], [0, 0, 1], [0, -1, 0]] * scale
    true = truth["surface_points"][0] * scale
    distances = np.array([np.linalg.norm(found - point, axis=1).min() for point in true[::8]])
    back = np.array([np.linalg.norm(true - point, axis=1).min() for point in found[::20]])
    assert metrics["chamfer_cm"] == pytest.approx(100 * (distances.mean() + back.mean()), rel=0.05)
    precision, recall = (back <= 0.01).mean(), (distances <= 0.01).mean()
    harmonic = 200 * precision * recall / max(precision + recall, 1e-9)
    assert metrics["f_10mm"] == pytest.approx(harmonic, abs=3)


def test_no_object_found(runs, video, tmp_path):
    blind = tmp_path / "blind"
    shutil.copytree(runs.one, blind)
    change_last_bias(blind, -1e4)
    text = refused(replace(runs, one=blind), tmp_path, video, "--count", 3)
    assert text.startswith(f"forehoi: {video}: no object found in 3 frames")


def test_missing_checkpoints_name_the_training(runs, video, tmp_path):
    nothing = tmp_path / "nothing"
    out = tmp_path / "new" / "out"
    text = fails("reconstruct", video, "--out", out, "--stage-one", nothing)
    assert f"{nothing}/stage_one: holds no checkpoint; expected a trained stage 1. Train it first" in text
    text = fails("reconstruct", video, "--out", out, "--stage-one", runs.one, "--stage-two", nothing)
    assert f"{nothing}/slat_flow: holds no checkpoint" in text
    assert "--stages one" in text
    assert not out.parent.exists()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "INPUT: missing"),
        (["x.mp4", "--held-out"], "given beside --held-out"),
        (["x.mp4", "--frames", "0", "--count", 1], "--count: given beside --frames"),
        (["x.mp4", "--frames", "0,b"], "not a list of numbers"),
        (["x.mp4"], "no such file or folder"),
        (["x.mp4", "--device", "abacus"], "--device abacus"),
    ],
)
def test_what_the_command_line_gets_wrong(runs, tmp_path, arguments, expected):
    assert expected in refused(runs, tmp_path, *arguments)


def test_frames_and_boxes_that_do_not_exist(runs, video, tmp_path):
    assert "frame 12 does not exist" in refused(runs, tmp_path, video, "--frames", "0,12")
    assert "outside of the image" in refused(runs, tmp_path, video, "--box", "200,0,300,90")
    assert "no such clip" in refused(runs, tmp_path, f"{runs.dataset}#nothing")
