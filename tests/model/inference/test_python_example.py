"""docs/examples/reconstruct.py, on the networks of this folder."""

import subprocess
import sys

import trimesh

from shards.reader import open_dataset
from tests.model.small_run import ROOT


def test_a_clip_becomes_a_watertight_mesh(runs, tmp_path):
    clip_id = open_dataset(runs.dataset).shards[0].record.clip_ids[0]
    command = [
        ROOT / "docs" / "examples" / "reconstruct.py",
        f"{runs.dataset}#{clip_id}",
        tmp_path / "object.glb",
    ]
    command += ["--stage-one", runs.one, "--stage-two", runs.two, "--frames", "2"]
    done = subprocess.run(
        [sys.executable, *map(str, command)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "faces, watertight" in done.stdout
    mesh = trimesh.load_mesh(tmp_path / "object.glb")
    assert mesh.is_watertight
    assert abs(mesh.bounds).max() <= 0.51
