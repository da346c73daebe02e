"""Interlaced videos without combs, their frames at their places."""

from pathlib import Path

import numpy as np
import pytest

from model.video.frames import ReadLimits
from model.video.reading import read_frames
from tests.model.video.encoded_videos import numbered_video, write_video

ALL = ReadLimits(max_frames=64, max_side_px=512)
SIZE = (160, 96)
STEP_PX = 10  # between fields
SIDE_PX = 32


def bar(field: int) -> np.ndarray:
    """A white bar on grey that moves to the right."""
    image = np.full((SIZE[1], SIZE[0], 3), 60, np.uint8)
    image[20:76, 4 + STEP_PX * field : 4 + STEP_PX * field + SIDE_PX] = 230
    return image


def woven(frame: int) -> np.ndarray:
    """Two moments in one frame, the earlier in the even rows."""
    image = bar(2 * frame)
    image[1::2] = bar(2 * frame + 1)[1::2]
    return image


def comb_rows(image: np.ndarray) -> int:
    """Pixels that differ from the rows above and below in the same direction, by much."""
    luma = image.astype(int).mean(axis=-1)
    above, below = luma[1:-1] - luma[:-2], luma[1:-1] - luma[2:]
    return int(((above * below > 0) & (np.minimum(abs(above), abs(below)) > 40)).sum())


@pytest.fixture(params=["i.mp4", "i.mpg"])
def interlaced(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    codec = {"i.mp4": "libx264", "i.mpg": "mpeg2video"}[request.param]
    options = (
        {"flags": "+ildct+ilme", "crf": "10"} if codec == "libx264" else {"flags": "+ildct+ilme", "b": "4M"}
    )
    frames = [woven(number) for number in range(6)]
    return write_video(
        tmp_path / request.param, frames, codec=codec, options=options, fps=25, interlaced=True
    )


def test_combs_are_gone_and_it_is_said(interlaced: Path) -> None:
    assert comb_rows(woven(2)) > 500
    frames = read_frames(interlaced, ALL)
    assert frames.indices.tolist() == list(range(6))
    assert [comb_rows(image) < 30 for image in frames.images] == [True] * 6
    assert frames.notes == ("deinterlaced (6 of 6 frames)",)
    np.testing.assert_allclose([frame.time_s for frame in frames.frames], np.arange(6) / 25, atol=1e-3)


def test_a_frame_shows_the_moment_of_its_first_field(interlaced: Path) -> None:
    for index in (1, 2, 4):  # alone, with the frames beside it
        image = read_frames(interlaced, ALL, indices=[index]).images[0]
        columns = np.flatnonzero(image[30:66].mean(axis=(0, 2)) > 145)
        assert abs(columns.mean() - (4 + STEP_PX * 2 * index + (SIDE_PX - 1) / 2)) <= STEP_PX / 2


def test_frames_that_are_not_interlaced_are_left_alone(tmp_path: Path) -> None:
    frames = read_frames(numbered_video(tmp_path / "p.mp4", 5), ALL)
    assert frames.notes == ()
    assert frames.changes == ()
