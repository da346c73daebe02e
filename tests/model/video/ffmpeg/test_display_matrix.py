"""Frames are upright, whatever data they carry beside their pixels."""

from pathlib import Path

import numpy as np
import pytest

from model.video.frames import ReadLimits
from model.video.reading import read_frames
from tests.model.video.encoded_videos import (
    corner_is_red,
    jpeg,
    numbered_frame,
    numbers,
    stored_for,
    write_packets,
)

ALL = ReadLimits(max_frames=64, max_side_px=512)


@pytest.mark.parametrize("name", ["m.avi", "m.mkv", "m.mov"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_data_of_motion_jpeg(tmp_path: Path, name: str, orientation: int) -> None:
    """PyAV 18.1 has no name for such data."""
    stored = [stored_for(numbered_frame(number), orientation) for number in range(4)]
    images = [jpeg(pixels, orientation) for pixels in stored]
    size = (stored[0].shape[1], stored[0].shape[0])
    frames = read_frames(write_packets(tmp_path / name, [("mjpeg", size, images)]), ALL)
    assert numbers(frames) == [0, 1, 2, 3]
    assert all(corner_is_red(image) for image in frames.images)
    assert {frame.source_size for frame in frames.frames} == {(160, 96)}


def test_each_frame_is_turned_as_it_says(tmp_path: Path) -> None:
    """As in a film joined from photos."""
    orientations = [1, 3, 1, 3, 3]
    images = [jpeg(stored_for(numbered_frame(number), o), o) for number, o in enumerate(orientations)]
    frames = read_frames(write_packets(tmp_path / "m.mkv", [("mjpeg", (160, 96), images)]), ALL)
    assert numbers(frames) == [0, 1, 2, 3, 4]
    assert all(corner_is_red(image) for image in frames.images)


def test_the_container_turns_frames_whose_data_have_no_name(tmp_path: Path) -> None:
    """EXIF data that say nothing of the orientation."""
    stored = [np.ascontiguousarray(np.rot90(numbered_frame(number), -1)) for number in range(3)]
    images = [jpeg(pixels, None) for pixels in stored]
    path = write_packets(tmp_path / "m.mov", [("mjpeg", (96, 160), images)], turn_deg=90)
    frames = read_frames(path, ALL)
    assert numbers(frames) == [0, 1, 2]
    assert all(corner_is_red(image) for image in frames.images)
