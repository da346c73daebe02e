"""Your own objects: from a folder of meshes (GLB, glTF, OBJ, PLY, STL) to a verified shard.

`datagen render --config own.yaml --shard 0` does the same from a shell. Meshes may be open or intersect themselves. An
objects.csv beside them (columns path, name, licence, author, url) states licences; without one they are NOASSERTION,
which is allowed here and keeps the meshes themselves out of the shards.

    python docs/examples/own_objects.py path/to/meshes data/own
"""

import argparse
from pathlib import Path

from datagen.config import load_config
from datagen.jobs.plan_dataset import plan_dataset
from datagen.jobs.render_shard import RenderOptions, ShardProgress, render_shard
from shards.verify import verify_dataset

CONFIG = """\
extends: tiny
name: own
objects: {{source: folder, path: {meshes}}}
selection: {{licence_allow: [cc0, by, NOASSERTION]}}
plan: {{motions: {sequences}, motions_per_shard: {sequences}}}
sampling:
  cameras: {{image_size: [{size_px}, {size_px}]}}
  render: {{samples: {samples}}}
"""


def report(progress: ShardProgress) -> None:
    """One line for each step that is finished."""
    if progress.done == progress.total:
        print(f"grasp sequence {progress.motion_index}: {progress.phase}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("meshes", type=Path)
    parser.add_argument("out", type=Path, help="dataset folder")
    parser.add_argument("--sequences", type=int, default=4)
    parser.add_argument("--size-px", type=int, default=256)
    parser.add_argument("--samples", type=int, default=12, help="samples per pixel")
    settings = vars(parser.parse_args())
    out = settings.pop("out")
    out.mkdir(parents=True, exist_ok=True)
    path = out / "own.yaml"
    path.write_text(CONFIG.format(**settings | {"meshes": settings["meshes"].resolve()}), encoding="utf-8")

    config = load_config(path)
    plan, _ = plan_dataset(config, out)
    options = RenderOptions(device="auto", workers=1, threads_per_worker=None)
    render_shard(path, config, plan, out, 0, options, report)
    for shard in verify_dataset(out):  # every byte, every number
        print(f"{shard.path}: {shard.n_clips} clips, {shard.n_frames} frames, {len(shard.findings)} faults")


if __name__ == "__main__":
    main()
