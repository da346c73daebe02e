"""Geometry buffers against Cycles' own passes."""

import subprocess
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from datagen.annotation.annotate import (
    ARM_VISIBLE,
    HAND_VISIBLE,
    OBJECT_VISIBLE,
    MotionGeometry,
    annotate_frame,
)
from datagen.jobs.render_motion import RENDERER
from datagen.scene.scene_file import save_scene
from tests.datagen.annotation.annotated_scenes import make_hand_scene


@pytest.mark.blender
def test_buffers_agree_with_the_passes_of_cycles(tmp_path):
    """Depth within 1e-4 relative for > 99.5 % of pixels, masks with IoU > 0.995."""
    pytest.importorskip("bpy")
    scene, _ = make_hand_scene((256, 192))
    save_scene(scene, tmp_path / "scene.npz")
    command = [*RENDERER, "--scene", str(tmp_path / "scene.npz"), "--passes"]
    command += ["--frames-dir", str(tmp_path), "--threads", "1"]
    child = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert child.returncode == 0, child.stderr[-2000:]
    geometry = MotionGeometry(scene)
    for frame in range(2):
        for camera, buffers in enumerate(annotate_frame(geometry, frame)):
            z, index = read_passes(tmp_path / f"cam-{camera:02d}" / f"passes-{frame:04d}.exr")
            met = (z > 0) | (buffers.depth > 0)
            agrees = ~met | (np.abs(z - buffers.depth) <= 1e-4 * buffers.depth)
            assert agrees.mean() > 0.995
            visible = buffers.masks & (HAND_VISIBLE | OBJECT_VISIBLE | ARM_VISIBLE)
            table = (buffers.depth > 0) & (visible == 0)
            for number, mask in (
                (1, (visible & OBJECT_VISIBLE) > 0),
                (2, (visible & HAND_VISIBLE) > 0),
                (3, (visible & ARM_VISIBLE) > 0),
                (4, table),
            ):
                theirs = np.rint(index) == number
                assert np.sum(theirs) > 100
                assert np.sum(theirs & mask) / np.sum(theirs | mask) > 0.995


def read_passes(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Z with 0 for nothing, and the material index (1 object, 2 hand, 3 arm, 4 table)."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = file.channels()
        z = channels["ViewLayer.Depth.Z"].pixels.astype(float)
        return np.where(z > 1e9, 0.0, z), channels["ViewLayer.IndexMA.X"].pixels
