"""Reconstruct from Python: a video or a folder of images to voxels and a coloured mesh.

The networks are those of two trainings (`make demo` trains both). `forehoi reconstruct` does the same and writes masks,
a turntable and a record as well.

    python docs/examples/reconstruct.py video.mp4 object.glb
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from model.inference.networks import load_networks, open_stage_one, open_stage_two
from model.inference.reconstruction import STANDARD, reconstruct
from model.inference.stage_clock import StageClock
from model.surface.export import glb_bytes
from model.video.frames import ReadLimits
from model.video.reading import read_informative_frames


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", help="video, folder of images, or DATASET#CLIP_ID")
    parser.add_argument("glb", type=Path)
    parser.add_argument("--stage-one", type=Path, default=Path("runs/tiny"))
    parser.add_argument("--stage-two", type=Path, default=Path("runs/tiny_slat"))
    parser.add_argument("--frames", type=int, default=4, help="how many to choose")
    arguments = parser.parse_args()

    candidates = ReadLimits(max_frames=64, max_side_px=512)
    frames, _ = read_informative_frames(arguments.source, arguments.frames, candidates, max_side_px=2048)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    networks = load_networks(open_stage_one(arguments.stage_one), open_stage_two(arguments.stage_two), device)
    clock = StageClock()
    result = reconstruct(frames, networks, STANDARD, clock=clock)
    print(f"frames {list(result.frames.indices)}: {len(result.voxels)} voxels")
    for stage, seconds in clock.seconds.items():
        print(f"{stage}: {seconds:.1f} s")
    for note in result.notes:
        print(f"note: {note}")
    assert result.surface is not None  # both stages were loaded
    arguments.glb.write_bytes(glb_bytes(result.surface.mesh, np.eye(4)))  # in the canonical cube: no metres
    print(f"{arguments.glb}: {result.surface.report.faces} faces, watertight")


if __name__ == "__main__":
    main()
