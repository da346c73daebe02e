"""The examples run, and the code in the README with them."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from datagen.config import load_config
from shards.reader import open_dataset
from tests.docs.documents import ROOT, code_blocks
from tests.shards.synthetic import synthetic_dataset

EXAMPLES = ROOT / "docs" / "examples"
# What the example of a foreign reader must do without: everything of ours, and most of what we use.
FOREIGN = (
    "shards",
    "datagen",
    "model",
    "fsspec",
    "torch",
    "PIL",
    "cv2",
    "scipy",
    "trimesh",
    "jaxtyping",
    "yaml",
)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    return synthetic_dataset(tmp_path_factory.mktemp("examples") / "balls")


def run(*command: object) -> str:
    done = subprocess.run(
        [sys.executable, *map(str, command)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_shards_are_read_without_this_package(dataset):
    blocked = f"import runpy, sys; sys.modules.update(dict.fromkeys({FOREIGN!r}));"
    code = f"{blocked} sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__')"
    lines = run("-c", code, EXAMPLES / "read_shards.py", dataset).splitlines()
    clips = list(open_dataset(dataset).clips())
    assert len(lines) == len(clips)
    for line, clip in zip(lines, clips):
        frames = open_dataset(dataset).read_frames(clip.clip_id)
        share = frames["object_pixels_visible"].sum() / frames["object_pixels_amodal"].sum()
        assert line.startswith(f"{clip.clip_id}  {clip.object_uid}  {share:.0%} visible")
        place = np.array([float(number) for number in re.findall(r"-?\d+\.\d{3}", line)])
        center = frames["T_world_from_obj"][-1] @ [
            0.01,
            0.0,
            0.0,
            1.0,
        ]  # of the ball; its front is what depth shows
        assert 0.005 < np.linalg.norm(place - center[:3]) < 0.04


def test_the_torch_loader_gives_batches_in_30_lines(dataset):
    path = EXAMPLES / "torch_loader.py"
    output = run(path, dataset)
    train = [clip for clip in open_dataset(dataset).clips() if clip.split == "train"]
    assert train
    first = min(4, sum(clip.n_frames for clip in train))
    assert f"'rgb': ({first}, 3, 40, 40), 'object_amodal': ({first}, 40, 40)" in output
    tree = ast.parse(path.read_text(encoding="utf-8"))
    lines = {line for node in tree.body[1:] for line in range(node.lineno, (node.end_lineno or 0) + 1)}
    text = path.read_text(encoding="utf-8").splitlines()
    assert len([line for line in lines if text[line - 1].strip()]) <= 30


@pytest.mark.blender
def test_a_folder_of_meshes_becomes_a_verified_shard(tmp_path):
    pytest.importorskip("bpy")
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    trimesh.creation.cylinder(radius=0.03, height=0.11).export(meshes / "can.obj")
    sizes = ("--sequences", 1, "--size-px", 64, "--samples", 2)
    output = run(EXAMPLES / "own_objects.py", meshes, tmp_path / "own", *sizes)
    assert re.search(r"shard-00000: 4 clips, 48 frames, 0 faults", output)
    (row,) = open_dataset(tmp_path / "own").objects()
    assert row.licence == "NOASSERTION"
    assert row.mesh_glb is None  # nobody allowed us to hand it on
    assert row.object_scale_m == pytest.approx(0.11, abs=0.002)


def test_the_code_of_the_readme_runs(dataset):
    (block,) = code_blocks((ROOT / "README.md").read_text(encoding="utf-8"), "python")
    run(
        "-c",
        block.replace("data/tiny", str(dataset)) + "\nassert occluded.any() and image.shape == (40, 40, 3)",
    )


def test_the_configurations_of_the_readme_are_complete(tmp_path):
    blocks = code_blocks((ROOT / "README.md").read_text(encoding="utf-8"), "yaml")
    assert len(blocks) == 2
    for number, block in enumerate(blocks):
        path = tmp_path / f"own-{number}.yaml"
        path.write_text(block)
        load_config(path)
