"""Look at a Scene in Blender's window: scrub the timeline, look through every camera."""

from typing import Any

import bpy

from datagen.blender.build import build_scene, show_frame, use_camera
from datagen.blender.devices import select_device
from datagen.blender.settings import apply_settings
from datagen.scene.scene import Scene

__all__ = ["open_in_window"]


def open_in_window(scene: Scene) -> None:
    """Fill the open Blender with `scene`; each motion frame is a Blender frame, camera after camera.

    Frame `camera * n_frames + frame` of the timeline is that frame seen by that camera; markers
    name where each camera begins. Works as long as the session lives: moved vertices are set by
    a handler, not stored as keyframes.
    """
    built = build_scene(scene)
    apply_settings(scene, select_device("auto"), 0)
    n_frames = len(scene.T_world_from_obj)
    timeline = bpy.context.scene
    timeline.frame_start, timeline.frame_end = 0, n_frames * len(scene.cameras) - 1
    timeline.render.fps = max(1, round(scene.fps))
    for index, camera in enumerate(scene.cameras):
        timeline.timeline_markers.new(f"camera {index} ({camera.kind})", frame=index * n_frames)

    def show(*_: Any) -> None:
        camera, frame = divmod(timeline.frame_current, n_frames)
        show_frame(built, frame)
        use_camera(built, scene.cameras[camera], frame)

    bpy.app.handlers.frame_change_post.append(show)
    timeline.frame_set(0)
