"""The command line of the child process that renders one Scene."""

import argparse
import os
import sys
import typing
from collections.abc import Sequence
from pathlib import Path

from datagen.blender.devices import DeviceError, DeviceRequest
from datagen.blender.log import RenderError, progress_channel
from datagen.blender.passes import render_passes
from datagen.blender.render import render_scene
from datagen.blender.shading.images import TextureError
from datagen.processes.child_process import die_with_parent
from datagen.scene.scene_file import SceneFileError, load_scene

__all__ = ["main"]


def main(arguments: Sequence[str]) -> typing.NoReturn:
    """Render, report by JSON lines on standard output, and end the process.

    Exit status: 0 done, 2 bad input (scene file, image, missing device), 1 Blender failed.
    The message is the last event on standard output and the last line on standard error.
    """
    options = _parser().parse_args(arguments)
    die_with_parent()
    progress, log = progress_channel()
    status = 0
    try:
        scene = load_scene(options.scene)
        if options.passes:
            render_passes(scene, options.frames_dir, threads=options.threads, progress=progress, log=log)
        else:
            render_scene(
                scene,
                options.frames_dir,
                device=options.device,
                threads=options.threads,
                progress=progress,
                log=log,
            )
    except (SceneFileError, TextureError, DeviceError, RenderError, OSError) as error:
        status = 2 if isinstance(error, ValueError) else 1
        progress.send("error", message=str(error), status=status)
        sys.stderr.write(f"{error}\n")
    # Blender's own shutdown takes a second and can hang on its threads; nothing is left to save.
    sys.stderr.flush()
    os._exit(status)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="Render the images of a scene file.")
    parser.add_argument("--scene", type=Path, required=True, help="scene file (.npz)")
    parser.add_argument(
        "--frames-dir", type=Path, required=True, help="folder of cam-00/frame-0000.png; resumed if begun"
    )
    parser.add_argument("--device", choices=typing.get_args(DeviceRequest), default="auto")
    parser.add_argument("--threads", type=int, default=0, help="0: every core")
    parser.add_argument(
        "--passes", action="store_true", help="write Cycles' Z and index passes (EXR) instead of images"
    )
    return parser
