"""The whole generator on a small dataset: verified, the same for any number of workers, and after kills."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from click.testing import CliRunner

from datagen.cli.main import main
from shards.reader import Dataset, open_dataset
from shards.schema import ClipRow, FrameRow
from shards.verify import verify_dataset

ROOT = Path(__file__).resolve().parents[3]
pytestmark = pytest.mark.blender

# Measurements of this run, and colours, whose last bits depend on how threads divide the work.
VARYING = {"render_seconds", "rgb"}


def small_config(
    folder: Path, *, motions: int = 2, cameras: int = 2, frames: int = 2, size: int = 48
) -> Path:
    """tiny.yaml on a folder of two plain objects, with few and small images."""
    meshes = folder / "meshes"
    meshes.mkdir(parents=True)
    trimesh.creation.box((0.06, 0.05, 0.14)).export(meshes / "box.ply")
    trimesh.creation.cylinder(0.032, 0.12, sections=24).export(meshes / "can.ply")
    config = yaml.safe_load((ROOT / "configs" / "datagen" / "tiny.yaml").read_text())
    config["objects"] |= {"source": "folder", "path": str(meshes), "cache_dir": str(folder / "cache")}
    config["objects"]["reading"] |= {"unit": "m", "up_axis": "z"}
    config["plan"] = {"motions": motions, "motions_per_shard": motions}
    config["selection"] |= {"licence_allow": ["NOASSERTION"]}
    config["sampling"]["clip"]["n_frames"] = frames
    config["sampling"]["cameras"] |= {"n_cameras": cameras, "image_size": [size, size]}
    config["sampling"]["render"] |= {"samples": 2, "max_bounces": 1, "denoise": False}
    config["targets"] |= {"surface_points": 256, "sdf_near_points": 256, "sdf_uniform_points": 128}
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


def render_command(config: Path, out: Path, *extra: str) -> list[str]:
    arguments = ["--config", str(config), "--out", str(out), "--shard", "0", "--device", "cpu", *extra]
    return [sys.executable, "-m", "datagen", "render", *arguments]


def rendered(config: Path, out: Path, *extra: str) -> Dataset:
    run = subprocess.run(render_command(config, out, *extra), cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return open_dataset(out)


def assert_same_data(a: Dataset, b: Dataset) -> None:
    """Every number of every row, images included, but for what depends on the machine."""
    clips_a, clips_b = list(a.clips()), list(b.clips())
    assert [clip.clip_id for clip in clips_a] == [clip.clip_id for clip in clips_b]
    for clip_a, clip_b in zip(clips_a, clips_b):
        assert_same_row(clip_a, clip_b, ClipRow)
        columns = [field.name for field in fields(FrameRow) if field.name not in VARYING]
        frames_a, frames_b = (d.read_frames(clip_a.clip_id, columns) for d in (a, b))
        assert frames_a.arrow.equals(frames_b.arrow)
    for object_a, object_b in zip(a.objects(), b.objects()):
        assert_same_row(object_a, object_b, type(object_a))


def assert_same_row(a: object, b: object, row_type: type) -> None:
    for field in fields(row_type):
        if field.name not in VARYING:
            np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name), err_msg=field.name)


@pytest.fixture(scope="module")
def config(tmp_path_factory) -> Path:
    return small_config(tmp_path_factory.mktemp("small"))


@pytest.fixture(scope="module")
def reference(config, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("reference")
    rendered(config, out)
    return out


def test_shard_is_verified_and_whole(reference):
    (report,) = verify_dataset(reference)
    assert report.ok, report.findings
    assert report.skipped == ()
    assert (report.n_clips, report.n_frames) == (4, 8)
    assert not (reference / "staging" / "shard-00000").exists()


def test_rendering_again_changes_nothing(config, reference):
    files = sorted(reference.rglob("*.parquet"))
    before = [path.stat().st_mtime_ns for path in files]
    rendered(config, reference)
    assert [path.stat().st_mtime_ns for path in files] == before


def test_two_workers_give_the_same_data(config, reference, tmp_path):
    assert_same_data(open_dataset(reference), rendered(config, tmp_path, "--workers", "2"))


def test_a_missing_gpu_is_one_line_and_exit_status_2(config, tmp_path):
    arguments = [
        "render",
        "--config",
        str(config),
        "--out",
        str(tmp_path),
        "--shard",
        "0",
        "--device",
        "optix",
    ]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 2
    assert "optix" in result.output.lower()
    assert "Traceback" not in result.output


def nan_mesh(path: Path) -> None:
    mesh = trimesh.creation.box((0.05, 0.05, 0.1))
    mesh.vertices[0] = np.nan
    path.write_bytes(trimesh.exchange.ply.export_ply(mesh))


def flat_mesh(path: Path) -> None:
    trimesh.Trimesh([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0]], [[0, 1, 2]], process=False).export(
        path
    )


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("empty.ply", lambda path: path.write_bytes(b"")),
        ("text.obj", lambda path: path.write_text("this is no mesh\n")),
        ("nan.ply", nan_mesh),
        ("flat.ply", flat_mesh),
    ],
)
def test_where_asked_to_a_bad_object_stops_in_one_line_before_anything_is_rendered(name, write, tmp_path):
    config = small_config(tmp_path)
    settings = yaml.safe_load(config.read_text())
    settings["selection"]["unusable"] = "stop"
    config.write_text(yaml.safe_dump(settings))
    write(tmp_path / "meshes" / name)
    out = tmp_path / "out"
    run = subprocess.run(render_command(config, out), cwd=ROOT, capture_output=True, text=True)
    message = [line for line in run.stderr.splitlines() if line.startswith("datagen:")]
    assert run.returncode == 2, run.stderr
    assert len(message) == 1
    assert name in message[0]
    assert "Traceback" not in run.stderr
    assert not (out / "plan.parquet").exists()


def test_the_plan_goes_on_without_bad_objects_and_names_them(tmp_path):
    config = small_config(tmp_path)
    (tmp_path / "meshes" / "empty.ply").write_bytes(b"")
    result = CliRunner().invoke(main, ["plan", "--config", str(config), "--out", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    assert "selection: 2 of 3 motions kept; removed: 1 object cannot be used" in result.output
    assert "cannot be used: folder/empty: " in result.output
    assert "is empty (0 bytes)" in result.output


@pytest.mark.slow
def test_killed_anywhere_and_continued_it_is_the_same(config, reference, tmp_path):
    """kill -9 after growing delays, until one run gets through; what was staged is never made again."""
    staged: dict[Path, int] = {}
    for attempt in range(40):
        process = subprocess.Popen(render_command(config, tmp_path), cwd=ROOT, stderr=subprocess.DEVNULL)
        try:
            status = process.wait(timeout=2.0 + 1.5 * attempt)
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
            time.sleep(0.2)  # the kernel ends the children too
            for path in tmp_path.glob("staging/shard-00000/motion-*/motion.json"):
                assert staged.setdefault(path, path.stat().st_mtime_ns) == path.stat().st_mtime_ns
            continue
        assert status == 0
        break
    else:
        pytest.fail("never got through")
    assert attempt > 1, "the first delay was long enough: nothing was killed"
    assert_same_data(open_dataset(reference), open_dataset(tmp_path))
