"""What a file of video holds: under any name, of any streams, with any clock; and nothing else is ever opened."""

import os
import struct
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from model.errors import ModelError
from model.video.frames import ReadLimits
from model.video.reading import read_frames
from tests.model.video.encoded_videos import (
    jpeg,
    numbered_frame,
    numbered_video,
    numbers,
    write_packets,
    write_video,
)

ALL = ReadLimits(max_frames=64, max_side_px=512)


@pytest.mark.parametrize(
    "name",
    [
        "12:30:05.mp4",
        "2024-01-01 12:30:05.mp4",
        "file:clip.mp4",
        "http:clip.mp4",
        "concat:a|b.mp4",
        "pipe:0.mp4",
        "-clip.mp4",
        "100% %03d.mp4",
        "frame#1.mp4",
        "[red]über 你好 👋.mp4",
        "two\nlines.mp4",
        os.fsdecode(b"latin-\xfc\xff.mp4"),
        "no_suffix",
        "UPPER.MP4",
    ],
)
def test_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    try:
        numbered_video(tmp_path / "plain.mp4", 4).rename(tmp_path / name)
    except OSError:
        pytest.skip("no such name on this disk")
    monkeypatch.chdir(tmp_path)
    for source in (name, f"./{name}", str(tmp_path / name)):
        frames = read_frames(source, ALL)
        assert numbers(frames) == [0, 1, 2, 3]
        assert frames.notes == ()


@pytest.mark.parametrize("name", ["list.m3u8", "list.mp4", "list"])
@pytest.mark.parametrize(
    "text",
    [
        "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{}\n#EXT-X-ENDLIST\n",
        "\ufeff#EXTM3U\n#EXTINF:1,\n{}\n",
        "ffconcat version 1.0\nfile '{}'\n",
        "[playlist]\nFile1={}\n",
    ],
)
def test_playlists_open_nothing(tmp_path: Path, name: str, text: str) -> None:
    video = numbered_video(tmp_path / "other.ts", 3)
    (tmp_path / name).write_text(text.format(video.name))
    with pytest.raises(
        ModelError, match=r"it is a playlist, which only names other files; expected the video"
    ):
        read_frames(tmp_path / name, ALL)


def test_patterns_of_names_are_no_sequences(tmp_path: Path) -> None:
    """FFmpeg would read frame_1.jpg, frame_2.jpg, ... for this one."""
    for number in (1, 2):
        (tmp_path / f"frame_{number}.jpg").write_bytes(jpeg(numbered_frame(number), 1))
    (tmp_path / "frame_%d.jpg").write_bytes(jpeg(numbered_frame(77), 1))
    assert numbers(read_frames(tmp_path / "frame_%d.jpg", ALL)) == [77]


def two_streams(path: Path, sizes: list[tuple[int, int]], counts: list[int], default: int | None) -> Path:
    """Streams of JPEGs numbered from 0, 100, ..."""
    streams = []
    for i, (size, count) in enumerate(zip(sizes, counts)):
        streams.append(("mjpeg", size, [jpeg(numbered_frame(100 * i + n, size), 1) for n in range(count)]))
    return write_packets(path, streams, default=default)


@pytest.mark.parametrize(
    ("sizes", "counts", "default", "first_number"),
    [
        ([(48, 32), (160, 96)], [1, 20], None, 100),  # a thumbnail before the film
        ([(320, 192), (160, 96)], [1, 20], None, 100),  # a large one
        ([(48, 32), (160, 96)], [20, 20], None, 100),  # a preview
        ([(160, 96), (160, 96)], [20, 20], None, 0),  # two cameras
        ([(160, 96), (160, 96)], [20, 20], 1, 100),
    ],
)
def test_the_film_among_streams(
    tmp_path: Path,
    sizes: list[tuple[int, int]],
    counts: list[int],
    default: int | None,
    first_number: int,
) -> None:
    frames = read_frames(two_streams(tmp_path / "two.mkv", sizes, counts, default), ALL)
    assert numbers(frames) == list(range(first_number, first_number + 20))
    stream = first_number // 100
    read = f"stream {stream} is read (mjpeg, {sizes[stream][0]} x {sizes[stream][1]}, 20 frames)"
    assert frames.notes == (f"the file holds 2 video streams: {read}",)


def test_cover_images_are_not_the_film(tmp_path: Path) -> None:
    film = ("mjpeg", (64, 48), [jpeg(numbered_frame(n, (64, 48)), 1) for n in range(5)])
    cover = ("mjpeg", (160, 96), [jpeg(numbered_frame(99), 1)])
    frames = read_frames(write_packets(tmp_path / "c.mp4", [film, cover], cover=1), ALL)
    assert numbers(frames) == list(range(5))
    with pytest.raises(ModelError, match=r"it holds a cover image, but no video"):
        read_frames(write_packets(tmp_path / "only.mp4", [cover], cover=0), ALL)


def joined(folder: Path, starts_s: tuple[float, float]) -> Path:
    """Two recordings of 12 frames, one behind the other, whose clocks start at these times."""
    data = b""
    for i, start_s in enumerate(starts_s):
        path = folder / f"{i}.ts"
        options = {"output_ts_offset": str(start_s), "muxdelay": "0"}
        frames = [numbered_frame(12 * i + n) for n in range(12)]
        data += write_video(path, frames, container_options=options).read_bytes()
    (folder / "joined.ts").write_bytes(data)
    return folder / "joined.ts"


@pytest.mark.parametrize(
    ("starts_s", "note"),
    [
        ((0.0, 0.0), "timestamps occur twice"),
        ((20.0, 0.0), "timestamps go back"),
        ((900.0, 0.0), "timestamps jump"),
    ],
)
def test_joined_recordings_keep_their_order(tmp_path: Path, starts_s: tuple[float, float], note: str) -> None:
    frames = read_frames(joined(tmp_path, starts_s), ALL)
    assert numbers(frames) == list(range(24))
    assert np.isnan([frame.time_s for frame in frames.frames]).all()
    assert frames.notes == (f"{note}: frames are taken as they are stored, times are unknown",)


def test_recordings_that_follow_each_other_have_times(tmp_path: Path) -> None:
    frames = read_frames(joined(tmp_path, (0.0, 2.0)), ALL)
    assert numbers(frames) == list(range(24))
    assert abs(frames.frames[12].time_s - 2.0) < 0.1
    assert frames.notes == ()


def test_what_an_edit_list_hides_is_not_missing(tmp_path: Path) -> None:
    """A cut without encoding keeps the frames from the key frame before it, hidden."""
    whole = numbered_video(tmp_path / "whole.mp4", 30, group=12)
    cut = tmp_path / "cut.mp4"
    with av.open(str(whole)) as source, av.open(str(cut), "w") as target:
        stream = source.streams.video[0]
        copy = target.add_stream_from_template(stream)
        for packet in source.demux(stream):
            if packet.pts is not None and packet.dts is not None:
                shift = round(Fraction(6, 30) / packet.time_base)
                packet.pts, packet.dts, packet.stream = packet.pts - shift, packet.dts - shift, copy
                target.mux(packet)
    frames = read_frames(cut, ALL)
    assert numbers(frames) == list(range(30 - len(frames), 30))
    assert frames.frames[0].time_s == 0.0
    assert frames.notes == ()


def test_matroska_that_is_cut_off(tmp_path: Path) -> None:
    whole = numbered_video(tmp_path / "a.mkv", 120, group=1)
    assert read_frames(whole, ALL).notes == ()
    data = whole.read_bytes()
    (tmp_path / "cut.mkv").write_bytes(data[: len(data) // 2])
    frames = read_frames(tmp_path / "cut.mkv", ALL)
    assert numbers(frames) == frames.indices.tolist()
    assert any("before the length that its header announces" in note for note in frames.notes)


def test_frames_too_large_to_decode(tmp_path: Path) -> None:
    """A header of a few bytes may ask for gigabytes: the container's, and that of a frame."""
    small = jpeg(numbered_frame(1), None)
    start = small.index(b"\xff\xc0") + 5
    huge = small[:start] + struct.pack(">HH", 20000, 20000) + small[start + 4 :]
    path = tmp_path / "huge.y4m"
    path.write_bytes(b"YUV4MPEG2 W12000 H12000 F25:1 Ip C420jpeg\nFRAME\n" + bytes(100))
    with pytest.raises(ModelError, match=r"huge\.y4m: .*12000 x 12000; expected at most 67 megapixels"):
        read_frames(path, ALL)
    path = write_packets(tmp_path / "grows.mkv", [("mjpeg", (160, 96), [small, huge, small])])
    frames = read_frames(path, ALL)
    assert frames.indices.tolist() == [0, 2]
    assert "1 of 3 candidate frames cannot be decoded and are left out" in frames.notes


def test_pixel_ratio_that_cannot_be(tmp_path: Path) -> None:
    frames = read_frames(numbered_video(tmp_path / "s.mkv", 2, pixel_ratio=Fraction(40, 1)), ALL)
    assert frames.images[0].shape == (96, 160, 3)
    assert any("not believed" in note for note in frames.notes)


def test_unreadable_file_is_one_line(tmp_path: Path) -> None:
    path = numbered_video(tmp_path / "locked.mp4", 2)
    path.chmod(0)
    if os.access(path, os.R_OK):
        pytest.skip("this user reads everything")
    with pytest.raises(ModelError, match=r"locked\.mp4: cannot be read \(permission denied\)"):
        read_frames(path, ALL)
