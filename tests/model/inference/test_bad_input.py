"""Inputs as people have them: cut, turned, huge, grey, transparent, a single image."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from model.inference.record import RECORD
from tests.model.small_run import fails, forehoi
from tests.model.video.encoded_videos import numbered_frame, numbered_video, write_video


def reconstructed(runs, source: Path, out: Path, *arguments: object) -> dict:
    """The record of a reconstruction by stage 1."""
    status, output = forehoi(
        "reconstruct", source, "--out", out, "--stage-one", runs.one, "--stages", "one", *arguments
    )
    assert status == 0, output
    return json.loads((out / RECORD).read_text())


def mask_sizes(out: Path) -> set[tuple[int, int]]:
    return {Image.open(path).size for path in (out / "masks").iterdir()}


def zero_bytes(path: Path) -> None:
    path.write_bytes(b"")


def no_frames(path: Path) -> None:
    """A container with a video stream and nothing in it."""
    whole = numbered_video(path.with_name("whole.mp4"), 3).read_bytes()
    path.write_bytes(whole[: whole.find(b"mdat")])


def unknown_codec(path: Path) -> None:
    data = numbered_video(path.with_name("known.mp4"), 3).read_bytes()
    assert data.count(b"avc1") >= 1
    path.write_bytes(data.replace(b"avc1", b"zzzz"))


def text_file(path: Path) -> None:
    path.write_text("not a video")


@pytest.mark.parametrize("make", [zero_bytes, no_frames, unknown_codec, text_file])
def test_what_is_no_video_ends_in_one_line_and_nothing_is_written(runs, tmp_path, make):
    source = tmp_path / "in.mp4"
    make(source)
    out = tmp_path / "new" / "out"
    text = fails("reconstruct", source, "--out", out, "--stage-one", runs.one, "--stages", "one")
    assert text.startswith(f"forehoi: {source}: ")
    assert not out.parent.exists()


def test_a_turned_video_gives_upright_masks(runs, tmp_path):
    source = numbered_video(tmp_path / "turned.mp4", 3, turn_deg=90)
    record = reconstructed(runs, source, tmp_path / "out", "--count", 1)
    assert mask_sizes(tmp_path / "out") == {(96, 160)}
    assert any("turned as its metadata say" in change for change in record["input"]["changes"])


def test_one_frame_of_4k_is_scaled_down_and_masks_are_not(runs, tmp_path):
    frame = np.kron(numbered_frame(1, (960, 540)), np.ones((4, 4, 1), np.uint8))
    source = write_video(tmp_path / "large.mp4", [frame], options={"preset": "ultrafast"})
    record = reconstructed(runs, source, tmp_path / "out")
    assert mask_sizes(tmp_path / "out") == {(3840, 2160)}
    assert any(
        "scaled down from 3840 x 2160 to 2048 x 1152" in change for change in record["input"]["changes"]
    )
    assert len(record["frames"]) == 1
    assert any("one frame only" in note for note in record["notes"])
    crop = record["frames"][0]["crop"]
    if crop["origin"] == "centre":  # in pixels of the source
        assert crop["side_px"] == 2160
        assert crop["corner_px"] == [840, 0]


def test_grey_and_transparent_images(runs, tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    rgb = numbered_frame(5)
    Image.fromarray(rgb).convert("L").save(folder / "0.png")
    alpha = np.full((*rgb.shape[:2], 1), 128, np.uint8)
    Image.fromarray(np.concatenate([rgb, alpha], axis=2)).save(folder / "1.png")
    Image.fromarray(rgb).save(folder / "2.jpg")
    record = reconstructed(runs, folder, tmp_path / "out", "--frames", "0,1,2")
    assert [frame["name"] for frame in record["frames"]] == ["0.png", "1.png", "2.jpg"]
    changes = " ".join(record["input"]["changes"])
    assert "grey copied to three channels (1 of 3 frames)" in changes
    assert "transparency laid over black (1 of 3 frames)" in changes


def test_names_that_no_terminal_can_show(runs, tmp_path):
    """Brackets are markup to the library that prints, bytes that are no UTF-8 cannot be encoded."""
    folder = tmp_path / "a[/b]"
    folder.mkdir(parents=True)
    name = os.fsdecode(b"[red]\xff.png")
    try:
        Image.fromarray(numbered_frame(5)).save(folder / name)
    except OSError:
        pytest.skip("no such name on this disk")
    (folder / "[blue].txt").write_text("x")
    out = tmp_path / "out"
    arguments = ("--out", out, "--stage-one", runs.one, "--stages", "one")
    status, output = forehoi("reconstruct", folder, *arguments)
    assert status == 0, output
    assert "a[/b]" in output
    assert "note: files that are no images were not read: 1 .txt" in output
    assert json.loads((out / RECORD).read_text())["frames"][0]["name"] == "[red]\\udcff.png"
