"""Cycles' own depth and index passes, to hold the ray-cast annotation against.

Blender's Z pass is the perpendicular distance (z in the camera frame), not the length of the
ray; background is 1e10. The index is the material index of `PassIndex`; background is 0.
"""

from pathlib import Path

import bpy

from datagen.blender.build import build_scene, show_frame, use_camera
from datagen.blender.devices import select_device
from datagen.blender.log import BlenderLog, ProgressChannel, RenderError
from datagen.blender.settings import apply_settings
from datagen.scene.scene import Scene

__all__ = ["pass_path", "render_passes"]


def pass_path(frames_dir: Path, camera: int, frame: int) -> Path:
    """Multilayer EXR with the channels ViewLayer.Depth.Z and ViewLayer.IndexMA.X."""
    return frames_dir / f"cam-{camera:02d}" / f"passes-{frame:04d}.exr"


def render_passes(
    scene: Scene, frames_dir: Path, *, threads: int, progress: ProgressChannel, log: BlenderLog
) -> None:
    """One sample per pixel, at the pixel's centre, for every camera and frame. CPU only."""
    built = build_scene(scene)
    apply_settings(scene, select_device("cpu"), threads)
    _one_sample_at_centres()
    for frame in range(len(scene.T_world_from_obj)):
        show_frame(built, frame)
        for index, camera in enumerate(scene.cameras):
            use_camera(built, camera, frame)
            path = pass_path(frames_dir, index, frame)
            path.parent.mkdir(parents=True, exist_ok=True)
            bpy.context.scene.render.filepath = str(path)
            try:
                bpy.ops.render.render(write_still=True)
            except RuntimeError as error:
                raise RenderError(f"passes of camera {index}, frame {frame}: {error}") from error
            log.check(f"passes of camera {index}, frame {frame}")
            progress.send("passes", camera=index, frame=frame, path=str(path.relative_to(frames_dir)))


def _one_sample_at_centres() -> None:
    scene = bpy.context.scene
    scene.cycles.samples = 1
    scene.cycles.max_bounces = 0
    scene.cycles.use_denoising = False
    scene.cycles.pixel_filter_type = "BOX"
    scene.cycles.filter_width = 0.01  # the smallest Cycles takes: within 0.005 pixel of the centre
    layer = scene.view_layers[0]
    layer.use_pass_z = layer.use_pass_material_index = True
    image = scene.render.image_settings
    image.file_format, image.color_depth, image.exr_codec = "OPEN_EXR_MULTILAYER", "32", "ZIP"
