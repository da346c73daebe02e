"""The renderer in a child process, on a small Scene of boxes."""

import dataclasses
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.objects.mesh.object_mesh import Material
from datagen.scene.scene import Background, RenderSettings, Scene
from datagen.scene.scene_file import save_scene
from tests.datagen.scene.boxes import made_box_scene, made_png

ROOT = Path(__file__).parents[3]
# Annotations are checked in the child process too.
CHECKED_MAIN = (
    "import sys; sys.path.insert(0, sys.argv.pop(1))\n"
    "from jaxtyping import install_import_hook\n"
    "with install_import_hook(['datagen', 'shards'], 'beartype.beartype'):\n"
    "    from datagen.blender.command import main\n"
    "main(sys.argv[1:])"
)


@dataclass(frozen=True, kw_only=True)
class Finished:
    """What a child process left behind."""

    status: int
    events: list[dict[str, Any]]
    other_lines: list[str]
    stderr: str


@pytest.fixture(scope="session")
def render():
    """Run the renderer on a Scene as the pipeline does."""

    def run(
        scene: Scene, frames_dir: Path, *options: str, command: tuple[str, ...] | None = None, **popen: Any
    ):
        frames_dir.parent.mkdir(parents=True, exist_ok=True)
        scene_path = frames_dir.with_suffix(".npz")
        save_scene(scene, scene_path)
        return _run_child(scene_path, frames_dir, *options, command=command, **popen)

    return run


@pytest.fixture(scope="session")
def box_scene() -> Scene:
    """Two frames, two cameras with every freedom of K: off-centre, oblong pixels, oblong image, roll."""
    return made_box_scene()


@pytest.fixture(scope="session")
def emissive_scene(box_scene) -> Scene:
    """The object alone, glowing in the dark: its image is its mask, filtered."""
    return _emissive_scene(box_scene)


@pytest.fixture(scope="session")
def rendering():
    """Run the renderer on a scene file."""
    return _run_child


@pytest.fixture(scope="session")
def png():
    """Make a small PNG of one colour."""
    return made_png


def _run_child(
    scene_path: Path, frames_dir: Path, *options: str, command: tuple[str, ...] | None = None, **popen: Any
) -> Finished:
    start = command or ("-c", CHECKED_MAIN, str(ROOT))
    done = subprocess.run(
        [
            sys.executable,
            *start,
            "--scene",
            scene_path,
            "--frames-dir",
            frames_dir,
            "--threads",
            "1",
            *options,
        ],
        capture_output=True,
        text=True,
        timeout=300,
        **popen,
    )
    lines = done.stdout.splitlines()
    return Finished(
        status=done.returncode,
        events=[json.loads(line) for line in lines if line.startswith("{")],
        other_lines=[line for line in lines if not line.startswith("{")],
        stderr=done.stderr,
    )


def _emissive_scene(scene: Scene) -> Scene:
    glow = Material(name="glow", base_color_rgba=(0.0, 0.0, 0.0, 1.0), emissive_rgb=(0.6, 0.6, 0.6))
    return dataclasses.replace(
        scene,
        object_mesh=dataclasses.replace(scene.object_mesh, materials=(glow,)),
        hand_verts_world=scene.hand_verts_world + np.array([0.0, 0.0, -50.0]),
        lights=(),
        background=Background(hdri="studio", rotation_rad=0.0, strength=0.0),
        table=None,
        render=RenderSettings(
            samples=64, max_bounces=0, denoise=False, exposure_ev=0.0, view_transform="Standard"
        ),
    )
