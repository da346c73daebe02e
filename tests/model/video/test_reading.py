"""Frames are read as often as they must be."""

from pathlib import Path

import numpy as np
import pytest

from model.video import reading
from model.video.frames import ReadLimits, VideoFrames
from model.video.reading import read_informative_frames
from tests.model.video.encoded_videos import numbered_frame, numbered_video, numbers, write_video


@pytest.mark.parametrize(("candidate_side_px", "readings"), [(160, 1), (80, 2)])
def test_small_videos_are_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, candidate_side_px: int, readings: int
) -> None:
    """Frames that are as large as they can be are not decoded again; the file is listed once."""
    calls: list[str] = []

    def counted(name: str) -> None:
        original = getattr(reading, name)

        def spy(*arguments: object) -> object:
            calls.append(name)
            return original(*arguments)

        monkeypatch.setattr(reading, name, spy)

    counted("listed_video")
    counted("read_video")
    path = numbered_video(tmp_path / "v.mp4", 12)
    candidates = ReadLimits(max_frames=12, max_side_px=candidate_side_px)
    frames, choice = read_informative_frames(path, 4, candidates, max_side_px=1024)
    assert calls == ["listed_video", *["read_video"] * readings]
    assert numbers(frames) == frames.indices.tolist() == choice.indices.tolist()
    assert {image.shape for image in frames.images} == {(96, 160, 3)}


def test_what_was_done_to_the_frames_used_is_told_once(tmp_path: Path) -> None:
    rgba = np.dstack([numbered_frame(1), np.zeros((96, 160, 1), np.uint8)])
    path = write_video(tmp_path / "t.mov", [rgba] * 4, codec="prores_ks", pix_fmt="yuva444p10le")
    for side_px in (80, 160):
        candidates = ReadLimits(max_frames=4, max_side_px=side_px)
        frames: VideoFrames = read_informative_frames(path, 2, candidates, max_side_px=160)[0]
        assert frames.notes == ("transparency laid over black (2 of 2 frames)",)
