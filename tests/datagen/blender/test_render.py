"""The child process: its protocol, resuming, and what it says when something is wrong."""

import dataclasses
import os
import resource
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from datagen.objects.mesh.object_mesh import Material
from datagen.scene.scene import Background
from datagen.scene.scene_file import save_scene

pytestmark = pytest.mark.blender
SCRIPT = Path(__file__).parents[3] / "blender_scripts" / "render_scene.py"


@pytest.fixture(scope="module")
def rendered(render, box_scene, tmp_path_factory):
    """The module itself, as the pipeline calls it."""
    frames_dir = tmp_path_factory.mktemp("render") / "frames"
    done = render(box_scene, frames_dir, command=("-m", "datagen.blender"))
    assert done.status == 0, done.stderr
    return done, frames_dir


def test_the_script_of_a_checkout_is_the_module(rendered, render, box_scene):
    _, frames_dir = rendered
    done = render(box_scene, frames_dir, command=(str(SCRIPT),))
    assert done.status == 0, done.stderr
    assert (done.events[0]["skipped"], done.events[-1]["rendered"]) == (4, 0)


def test_standard_output_is_the_protocol_and_nothing_else(rendered, box_scene):
    done, frames_dir = rendered
    assert done.other_lines == []
    assert [event["event"] for event in done.events] == ["start", *["frame"] * 4, "done"]
    start, *frames, end = done.events
    assert (start["images"], start["skipped"], end["rendered"]) == (4, 0, 4)
    assert [(e["frame"], e["camera"]) for e in frames] == [(0, 0), (0, 1), (1, 0), (1, 1)]
    assert end["device"] in ("CPU", "OPTIX", "CUDA", "HIP", "METAL")
    assert end["bpy_version"].startswith("4.5")
    assert set(end["seconds"]) == {"build", "sync", "render", "write", "total"}
    assert all(set(e["seconds"]) == {"sync", "render", "write"} for e in frames)
    for event in frames:
        size = box_scene.cameras[event["camera"]].image_size
        image = Image.open(frames_dir / event["path"])
        assert (image.mode, image.size) == ("RGB", size)
        assert np.asarray(image).std() > 10.0


def test_a_resumed_run_makes_only_what_is_missing_and_the_same_bytes(rendered, render, box_scene):
    _, frames_dir = rendered
    before = {path: path.read_bytes() for path in frames_dir.glob("cam-*/*.png")}
    gone = frames_dir / "cam-01" / "frame-0000.png"
    gone.unlink()
    (frames_dir / "cam-00" / ".frame-0001.partial.png").write_bytes(b"killed while writing")
    done = render(box_scene, frames_dir)
    assert done.status == 0, done.stderr
    assert (done.events[0]["skipped"], done.events[-1]["rendered"]) == (3, 1)
    assert {path: path.read_bytes() for path in frames_dir.glob("cam-*/frame*.png")} == before


def test_images_of_another_scene_are_not_taken_for_ours(rendered, render, box_scene):
    _, frames_dir = rendered
    kept = frames_dir / "cam-00" / "frame-0000.png"
    before = kept.read_bytes()
    one = dataclasses.replace(
        box_scene,
        seed=6,
        T_world_from_obj=box_scene.T_world_from_obj[:1],
        hand_verts_world=box_scene.hand_verts_world[:1],
        cameras=tuple(
            dataclasses.replace(c, T_cam_from_world=c.T_cam_from_world[:1]) for c in box_scene.cameras
        ),
    )
    done = render(one, frames_dir)
    assert (done.events[0]["skipped"], done.events[-1]["rendered"]) == (0, 2)
    assert kept.read_bytes() != before
    assert len(list(frames_dir.glob("cam-*/frame*.png"))) == 2


def test_a_missing_gpu_is_an_error_not_a_slow_run(render, box_scene, tmp_path):
    done = render(box_scene, tmp_path / "gpu", "--device", "metal")
    if done.status == 0:
        pytest.skip("this machine has the device")
    assert done.status == 2
    assert "--device metal: no such device in this machine (found" in done.stderr
    assert done.events[-1]["event"] == "error"
    assert not list((tmp_path / "gpu").glob("cam-*/*.png"))


def test_a_damaged_texture_is_named(render, box_scene, png, tmp_path):
    label = Material(
        name="label", base_color_rgba=(1.0, 1.0, 1.0, 1.0), base_color_image=png((200, 0, 0))[:-20]
    )
    mesh = dataclasses.replace(box_scene.object_mesh, materials=(label,))
    done = render(dataclasses.replace(box_scene, object_mesh=mesh), tmp_path / "torn")
    assert done.status == 2
    assert "label colour: not a readable image" in done.stderr
    assert "label colour" in done.events[-1]["message"]


def test_an_unknown_environment_is_named_with_those_there_are(render, box_scene, tmp_path):
    scene = dataclasses.replace(box_scene, background=Background(hdri="moon", rotation_rad=0.0, strength=1.0))
    done = render(scene, tmp_path / "moon")
    assert done.status == 2
    assert "no HDRI called 'moon'; Blender ships city, courtyard" in done.stderr


def test_a_truncated_scene_file_is_refused(rendering, box_scene, tmp_path):
    scene_path = tmp_path / "scene.npz"
    save_scene(box_scene, scene_path)
    scene_path.write_bytes(scene_path.read_bytes()[:-100])
    done = rendering(scene_path, tmp_path / "frames")
    assert done.status == 2
    assert "not a complete scene file" in done.stderr


@pytest.mark.skipif(os.name != "posix", reason="limits of a process")
def test_a_image_that_cannot_be_written_whole_ends_the_run(render, box_scene, tmp_path):
    def full_disk():
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))

    done = render(box_scene, tmp_path / "full", preexec_fn=full_disk)
    assert done.status == 1
    assert done.stderr.strip()
    assert done.events[-1]["event"] == "error"
    assert not list((tmp_path / "full").glob("cam-*/frame*.png"))


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_images(render, box_scene, tmp_path):
    n = 300
    few = dataclasses.replace(
        box_scene,
        T_world_from_obj=np.repeat(box_scene.T_world_from_obj, n // 2, axis=0),
        hand_verts_world=np.repeat(box_scene.hand_verts_world, n // 2, axis=0),
        cameras=tuple(
            dataclasses.replace(
                c,
                K=c.K * [[0.25], [0.25], [1.0]],
                image_size=(24, 18),
                T_cam_from_world=np.repeat(c.T_cam_from_world, n // 2, axis=0),
            )
            for c in box_scene.cameras[:2]
        ),
        render=dataclasses.replace(box_scene.render, samples=1),
    )
    done = render(few, tmp_path / "many")
    assert done.status == 0, done.stderr
    peaks = [event["peak_rss_mb"] for event in done.events if event["event"] == "frame"]
    assert peaks[599] - peaks[99] < 5.0  # over 500 images
