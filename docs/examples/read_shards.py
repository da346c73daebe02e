"""Read shards without this package: pyarrow, NumPy and OpenEXR are enough.

For every clip of a dataset: how much of the object the camera sees, from two depth images, and where the object is.
Columns and conventions: shards/README.md.

    python docs/examples/read_shards.py data/tiny
"""

import argparse
import io
from pathlib import Path

import numpy as np
import OpenEXR
import pyarrow.parquet as pq


def depths_m(exr: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Depth (z in the camera frame, 0 where nothing is) of the scene, and of the object as if it were alone."""
    with OpenEXR.File(io.BytesIO(exr), separate_channels=True) as file:
        channels = file.channels()
        return channels["Z"].pixels, channels["object.Z"].pixels


def points_world(depth_m: np.ndarray, K: np.ndarray, T_cam_from_world: np.ndarray) -> np.ndarray:
    """The pixels of a depth image as points (n, 3), metres. The first pixel's centre is (0.5, 0.5)."""
    row, column = np.nonzero(depth_m)
    z = depth_m[row, column].astype(np.float64)
    pixels = np.stack([column + 0.5, row + 0.5, np.ones(len(z))])
    points_cam = z * (np.linalg.inv(K) @ pixels)
    rotation, translation = T_cam_from_world[:3, :3], T_cam_from_world[:3, 3:]
    points: np.ndarray = rotation.T @ (points_cam - translation)
    return points.T


def clip_line(clip: dict, frames: list[dict]) -> str:
    """What the camera of one clip sees of the object, and where the object is at the end."""
    depths = [depths_m(frame["geometry"]) for frame in frames]
    alone = sum(np.count_nonzero(depth_object) for _, depth_object in depths)
    seen = sum(
        np.count_nonzero((depth_object > 0) & (depth_object <= depth)) for depth, depth_object in depths
    )
    _, last = depths[-1]
    points = points_world(last, np.array(clip["K"]), np.array(frames[-1]["T_cam_from_world"]))
    x, y, z = points.mean(axis=0)
    return f"{clip['clip_id']}  {clip['object_uid']}  {seen / alone:.0%} visible, at ({x:.3f}, {y:.3f}, {z:.3f}) m"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path)
    dataset = parser.parse_args().dataset
    for record in sorted(dataset.glob("shards/shard-*/shard.json")):  # without it a shard is not finished
        clips = pq.read_table(record.parent / "clips.parquet").to_pylist()
        frames = pq.ParquetFile(record.parent / "frames.parquet", page_checksum_verification=True)
        for index, clip in enumerate(clips):  # row group i holds the frames of clip i
            rows = frames.read_row_group(index, columns=["T_cam_from_world", "geometry"])
            print(clip_line(clip, rows.to_pylist()))


if __name__ == "__main__":
    main()
