"""Where the rendered images of a Scene lie: written by Blender, read by the worker that annotates them."""

from pathlib import Path

__all__ = ["FRAME_PATTERN", "frame_path"]

FRAME_PATTERN = "cam-*/frame-*.png"  # of all of them, in the folder of one motion


def frame_path(frames_dir: Path, camera: int, frame: int) -> Path:
    """The image of one camera and frame: cam-03/frame-0007.png."""
    return frames_dir / f"cam-{camera:02d}" / f"frame-{frame:04d}.png"
