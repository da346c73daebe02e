"""Cost of everything around Cycles, on the real pipeline. Shares are of one run, so machines compare."""

import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from datagen.annotation.annotate import MotionGeometry, annotate_frame
from datagen.config import load_config
from datagen.jobs.plan_dataset import plan_dataset
from datagen.jobs.render_motion import RENDERER, Job, sampled_motion
from datagen.processes.phase_timer import PhaseTimer
from datagen.scene.scene import Scene
from datagen.scene.scene_file import save_scene
from datagen.sources.objects import open_library
from shards.reader import open_dataset

ROOT = Path(__file__).resolve().parents[2]
NOT_OVERHEAD = {"grasp", "blender", "blender.render", "blender.total"}


def one_motion_config(folder: Path, **cameras: object) -> Path:
    """tiny.yaml with a single motion."""
    config = yaml.safe_load((ROOT / "configs" / "datagen" / "tiny.yaml").read_text())
    config["plan"] = {"motions": 1, "motions_per_shard": 1}
    config["sampling"]["cameras"] |= cameras
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


def render(config: Path, out: Path) -> dict[str, float]:
    """Render shard 0; the motion's seconds per phase."""
    command = [
        sys.executable,
        "-m",
        "datagen",
        "render",
        "--config",
        str(config),
        "--out",
        str(out),
        "--shard",
        "0",
    ]
    subprocess.run([*command, "--device", "cpu"], check=True, cwd=ROOT, capture_output=True)
    (motion,) = open_dataset(out).shards[0].record.motions
    return motion.timings_s


def test_overhead_outside_cycles(tmp_path, say):
    seconds = render(one_motion_config(tmp_path), tmp_path / "data")
    cycles = seconds["blender.render"]
    others = {
        "blender start, build, sync, write": seconds["blender"] - cycles,
        **{
            phase: s
            for phase, s in seconds.items()
            if phase not in NOT_OVERHEAD and not phase.startswith("blender.")
        },
    }
    overhead = sum(others.values())
    say(
        f"Cycles {cycles:.1f} s; outside Cycles {overhead:.1f} s = {overhead / cycles:.1%} (claim: at most 15 %)"
    )
    for phase, s in sorted(others.items(), key=lambda item: -item[1]):
        say(f"    {phase:36s} {s:6.2f} s  {s / cycles:6.1%}")
    say(f"    grasp synthesis (not counted)        {seconds['grasp']:6.2f} s")


def sampled_scene(folder: Path, config_path: Path) -> Scene:
    """The scene of the first motion of a configuration."""
    config = load_config(config_path)
    plan, _ = plan_dataset(config, folder / "data")
    job = Job(config=config, motion=plan.motions[0], out=folder / "data", device="cpu", threads=1)
    asset = open_library(config.objects, config.motions).load(job.motion.object_uid)
    return sampled_motion(job, asset, PhaseTimer()).scene


def test_annotation_per_512_frame(tmp_path, say):
    scene = sampled_scene(tmp_path, one_motion_config(tmp_path, image_size=[512, 512]))
    geometry = MotionGeometry(scene)
    annotate_frame(geometry, 0)
    began, n_frames = time.process_time(), 5
    for frame in range(1, 1 + n_frames):
        annotate_frame(geometry, frame)
    cost = (time.process_time() - began) / (n_frames * len(scene.cameras))
    say(f"annotation {1e3 * cost:.1f} ms of one core per 512 x 512 frame (claim: at most 60 ms)")


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_resident_memory_over_500_frames(tmp_path, say):
    """Resident memory of the render child after each image, read from outside."""
    path = one_motion_config(tmp_path, n_cameras=5, image_size=[32, 32], min_object_size=0.01)
    data = yaml.safe_load(path.read_text())
    data["sampling"]["clip"] |= {"n_frames": 100, "fps": [30.0]}
    data["sampling"]["render"] |= {"samples": 1}
    path.write_text(yaml.safe_dump(data))
    save_scene(sampled_scene(tmp_path, path), tmp_path / "scene.npz")
    command = [*RENDERER, "--scene", str(tmp_path / "scene.npz"), "--device", "cpu"]
    rss_mb = []
    with subprocess.Popen(
        [*command, "--frames-dir", str(tmp_path / "frames")],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as child:
        assert child.stdout is not None
        for line in child.stdout:
            if json.loads(line)["event"] == "frame":
                pages = int(Path(f"/proc/{child.pid}/statm").read_text().split()[1])
                rss_mb.append(pages * resource.getpagesize() / 1e6)
    assert child.returncode == 0
    settled = np.array(rss_mb[20:])  # Cycles allocates its pools during the first images
    growth = float(np.median(settled[-50:]) - np.median(settled[:50]))
    say(
        f"render child: {len(rss_mb)} frames, resident {settled[0]:.0f} MB, growth {growth:+.1f} MB (claim: < 5 MB)"
    )
