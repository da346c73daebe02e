"""Render every image of a Scene, resumably, and report each one."""

import hashlib
import resource
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from datagen.blender.build import BuiltScene, build_scene, show_frame, use_camera
from datagen.blender.devices import DeviceRequest, select_device
from datagen.blender.log import BlenderLog, ProgressChannel, RenderError
from datagen.blender.png import finish_image
from datagen.blender.settings import apply_settings, sampling_seed
from datagen.scene.frame_files import FRAME_PATTERN, frame_path
from datagen.scene.scene import Scene
from datagen.scene.scene_file import scene_sha256
from shards.storage.whole_file import write_whole

__all__ = ["Image", "render_scene", "resume_key"]

_KEY_FILE = "images.sha256"


@dataclass(frozen=True, kw_only=True)
class Image:
    """One image to make."""

    camera: int
    frame: int
    path: Path


def render_scene(
    scene: Scene,
    frames_dir: Path,
    *,
    device: DeviceRequest,
    threads: int,
    progress: ProgressChannel,
    log: BlenderLog,
) -> None:
    """Write all images that are not there yet, frames outer and cameras inner.

    Cameras share the posed meshes and the BVH of a frame, so they are the inner loop (DECISIONS D81).
    Raises DeviceError, TextureError, RenderError.
    """
    started = time.perf_counter()
    key = resume_key(scene)
    missing = _missing_images(scene, frames_dir, key)
    n_images = len(scene.cameras) * len(scene.T_world_from_obj)
    built = build_scene(scene)
    used = select_device(device)
    apply_settings(scene, used, threads)
    log.check("build")
    seconds = {"build": time.perf_counter() - started, "sync": 0.0, "render": 0.0, "write": 0.0}
    common = {"device": used.backend, "device_names": used.names, "bpy_version": bpy.app.version_string}
    progress.send(
        "start",
        images=n_images,
        skipped=n_images - len(missing),
        resume_key=key,
        seconds=dict(seconds),
        **common,
    )
    clock = _PhaseClock()
    shown = None
    for image in missing:
        if image.frame != shown:  # touching a mesh makes Cycles rebuild its BVH
            show_frame(built, image.frame)
            shown = image.frame
        spent = _render_image(built, image, clock, log)
        for phase, value in spent.items():
            seconds[phase] += value
        path = str(image.path.relative_to(frames_dir))
        progress.send(
            "frame",
            camera=image.camera,
            frame=image.frame,
            path=path,
            seconds=_rounded(spent),
            peak_rss_mb=_peak_rss_mb(),
        )
    clock.close()
    seconds["total"] = time.perf_counter() - started
    progress.send(
        "done",
        rendered=len(missing),
        skipped=n_images - len(missing),
        peak_rss_mb=_peak_rss_mb(),
        cpu_seconds=round(time.process_time(), 3),
        seconds=_rounded(seconds),
        **common,
    )


def resume_key(scene: Scene) -> str:
    """Hash of all that decides the images: the scene, Blender's version and this package's source."""
    sha = hashlib.sha256(scene_sha256(scene).encode())
    sha.update(bpy.app.version_string.encode())
    for source in sorted(Path(__file__).parent.rglob("*.py")):
        sha.update(source.read_bytes())
    return sha.hexdigest()


def _missing_images(scene: Scene, frames_dir: Path, key: str) -> list[Image]:
    """Images still to make; images of another scene are removed before the key is changed."""
    frames_dir.mkdir(parents=True, exist_ok=True)
    key_file = frames_dir / _KEY_FILE
    if not key_file.is_file() or key_file.read_text() != key:
        key_file.unlink(missing_ok=True)
        for stale in frames_dir.glob(FRAME_PATTERN):
            stale.unlink()
        with write_whole(key_file) as partial:
            partial.write_text(key)
    images = [
        Image(camera=camera, frame=frame, path=frame_path(frames_dir, camera, frame))
        for frame in range(len(scene.T_world_from_obj))
        for camera in range(len(scene.cameras))
    ]
    return [image for image in images if not image.path.is_file()]


def _render_image(built: BuiltScene, image: Image, clock: "_PhaseClock", log: BlenderLog) -> dict[str, float]:
    scene, blender = built.scene, bpy.context.scene
    started = time.perf_counter()
    camera = scene.cameras[image.camera]
    use_camera(built, camera, image.frame)
    blender.cycles.seed = sampling_seed(scene.seed, image.camera, image.frame)
    image.path.parent.mkdir(parents=True, exist_ok=True)
    partial = image.path.with_name(f".{image.path.stem}.partial.png")
    blender.render.filepath = str(partial)
    clock.reset()
    try:
        bpy.ops.render.render(write_still=True)
    except RuntimeError as error:
        raise RenderError(f"camera {image.camera}, frame {image.frame}: {error}") from error
    log.check(f"camera {image.camera}, frame {image.frame}")
    finish_image(partial, image.path)
    return {
        "sync": clock.first_sample - started,
        "render": clock.rendered - clock.first_sample,
        "write": time.perf_counter() - clock.rendered,
    }


class _PhaseClock:
    """When Cycles stopped preparing and when it finished, from Blender's own messages."""

    def __init__(self) -> None:
        self.reset()
        bpy.app.handlers.render_stats.append(self._on_stats)
        bpy.app.handlers.render_post.append(self._on_post)

    def reset(self) -> None:
        self.first_sample = self.rendered = time.perf_counter()
        self._waiting = True

    def close(self) -> None:
        bpy.app.handlers.render_stats.remove(self._on_stats)
        bpy.app.handlers.render_post.remove(self._on_post)

    def _on_stats(self, text: Any, _: Any = None) -> None:
        if self._waiting and "Sample " in str(text):
            self.first_sample, self._waiting = time.perf_counter(), False

    def _on_post(self, *_: Any) -> None:
        self.rendered = time.perf_counter()


def _peak_rss_mb() -> float:
    kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # bytes on macOS
    return round(kib / (1024.0**2 if sys.platform == "darwin" else 1024.0), 1)


def _rounded(seconds: dict[str, float]) -> dict[str, float]:
    return {phase: round(value, 4) for phase, value in seconds.items()}
