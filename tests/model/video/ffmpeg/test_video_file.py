"""Reading videos: the right frames, upright, in bounded memory; one clear line for what cannot be read."""

import gc
import os
import tracemalloc
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from model.errors import ModelError
from model.video.frames import ReadLimits
from model.video.orientation import upright
from model.video.reading import read_frames, read_informative_frames
from tests.model.video.encoded_videos import (
    corner_is_red,
    number_of,
    numbered_frame,
    numbered_video,
    numbers,
    write_video,
)

ALL = ReadLimits(max_frames=256, max_side_px=2048)
STATM = Path("/proc/self/statm")


def resident_mb() -> float:
    return int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def one_line(error: pytest.ExceptionInfo[ModelError], *parts: str) -> None:
    text = str(error.value)
    assert "\n" not in text
    for part in (*parts, "; expected "):
        assert part in text


@pytest.mark.parametrize(
    ("name", "codec", "pix_fmt"),
    [
        ("a.mp4", "libx264", "yuv420p"),
        ("a.mov", "libx265", "yuv420p"),
        ("b.mov", "prores_ks", "yuv422p10le"),
        ("a.webm", "libvpx-vp9", "yuv420p"),
        ("a.mkv", "libsvtav1", "yuv420p"),
        ("a.avi", "mpeg4", "yuv420p"),
        ("a.mkv", "ffv1", "gray"),
        ("a.gif", "gif", "rgb8"),
        ("burst.heics", "libx265", "yuv420p"),
    ],
)
def test_every_frame_of_common_formats(tmp_path: Path, name: str, codec: str, pix_fmt: str) -> None:
    # A HEIC sequence is an mp4 of another brand.
    settings: dict[str, Any] = {}
    if name.endswith(".heics"):
        settings = {"container_format": "mp4", "container_options": {"brand": "hevc"}}
    path = numbered_video(tmp_path / name, 20, codec=codec, pix_fmt=pix_fmt, fps=25, **settings)
    frames = read_frames(path, ALL)
    assert numbers(frames) == list(range(20))
    assert frames.indices.tolist() == list(range(20))
    assert frames.n_source_frames == 20
    assert frames.notes == ()
    times_s = [frame.time_s for frame in frames.frames]
    np.testing.assert_allclose(times_s, np.arange(20) / 25, atol=6e-3)  # GIF counts 1/100 s
    assert all(frame.source_size == (160, 96) for frame in frames.frames)


def test_colours_survive(tmp_path: Path) -> None:
    colour = np.full((96, 160, 3), (200, 40, 90), np.uint8)
    for codec, name in (("libx264", "c.mp4"), ("libx265", "c.mov"), ("libvpx-vp9", "c.webm")):
        image = read_frames(write_video(tmp_path / name, [colour] * 3, codec=codec), ALL).images[0]
        assert np.abs(image.astype(int) - colour).max() <= 4


@pytest.mark.parametrize("turn", [90, 180, 270])
def test_rotation_metadata_is_respected(tmp_path: Path, turn: int) -> None:
    """A phone stores the sensor's image, and how far to turn it against the clock."""
    scene = [numbered_frame(i) for i in (5, 6, 7)]
    stored = [np.ascontiguousarray(np.rot90(image, -turn // 90)) for image in scene]
    frames = read_frames(write_video(tmp_path / "r.mp4", stored, turn_deg=turn), ALL)
    assert frames.images[0].shape == scene[0].shape
    assert frames.frames[0].source_size == (160, 96)
    assert numbers(frames) == [5, 6, 7]
    assert corner_is_red(frames.images[0])
    assert frames.changes[0].startswith("turned as its metadata say")


def test_turned_and_scaled_down_together(tmp_path: Path) -> None:
    stored = [np.ascontiguousarray(np.rot90(numbered_frame(3, (400, 1000)), -1))]
    path = write_video(tmp_path / "r.mov", stored, turn_deg=90, codec="libx265")
    frame = read_frames(path, ReadLimits(max_frames=1, max_side_px=250)).frames[0]
    assert frame.image.shape == (250, 100, 3)
    assert frame.source_size == (400, 1000)
    assert corner_is_red(frame.image)


def test_mirrored_video_is_mirrored_back(tmp_path: Path) -> None:
    stored = [np.ascontiguousarray(numbered_frame(5)[:, ::-1])]
    frames = read_frames(write_video(tmp_path / "m.mp4", stored, turn_deg=0, hflip=True), ALL)
    assert numbers(frames) == [5]
    assert corner_is_red(frames.images[0])


def test_display_matrix_moves_every_pixel_as_its_definition_says() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (3, 5, 3), dtype=np.uint8)
    for a, b, c, d in (
        (1, 0, 0, 1),
        (0, 1, -1, 0),
        (-1, 0, 0, -1),
        (0, -1, 1, 0),
        (-1, 0, 0, 1),
        (0, 1, 1, 0),
    ):
        matrix = np.array([[a, b], [c, d]]) * 65536
        shown = upright(image, matrix)
        x, y = np.meshgrid(np.arange(5) + 0.5, np.arange(3) + 0.5)
        new_x, new_y = a * x + c * y, b * x + d * y
        new_x, new_y = (np.floor(v - np.floor(v.min())).astype(int) for v in (new_x, new_y))
        np.testing.assert_array_equal(shown[new_y, new_x], image)


def test_4k_is_scaled_down_while_decoding(tmp_path: Path) -> None:
    big = (3840, 2160)
    path = numbered_video(tmp_path / "4k.mp4", 9, size=big, options={"preset": "ultrafast"})
    tracemalloc.start()
    frames = read_frames(path, ReadLimits(max_frames=8, max_side_px=640))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert {image.shape for image in frames.images} == {(360, 640, 3)}
    assert {frame.source_size for frame in frames.frames} == {big}
    assert numbers(frames) == frames.indices.tolist()
    assert peak < 3840 * 2160 * 3  # not even one full image in Python's memory
    assert frames.changes == ("scaled down from 3840 x 2160 to 640 x 360 (8 of 8 frames)",)


@pytest.mark.skipif(not STATM.exists(), reason="reads the memory of the process from Linux")
def test_decoded_frames_do_not_pile_up(tmp_path: Path) -> None:
    """24 frames of 4K are 300 MB; what remains is 24 thumbnails, without waiting for the collector."""
    path = numbered_video(tmp_path / "4k.mp4", 24, size=(3840, 2160), options={"preset": "ultrafast"})
    gc.collect()
    gc.disable()
    try:
        before = resident_mb()
        frames = read_frames(path, ReadLimits(max_frames=24, max_side_px=64))
        grown = resident_mb() - before
    finally:
        gc.enable()
    assert len(frames) == 24
    assert grown < 120


def test_chosen_frames_are_read_again_at_full_size(tmp_path: Path) -> None:
    path = numbered_video(tmp_path / "big.mp4", 24, size=(1280, 720), options={"preset": "ultrafast"})
    candidates = ReadLimits(max_frames=12, max_side_px=160)
    frames, choice = read_informative_frames(path, 3, candidates, max_side_px=1024)
    assert {image.shape for image in frames.images} == {(576, 1024, 3)}
    assert numbers(frames) == frames.indices.tolist() == choice.indices.tolist()
    assert len({index // 2 for index in choice.indices}) == 3  # of twelve stretches with a candidate each
    assert frames.notes == ()
    few, _ = read_informative_frames(numbered_video(tmp_path / "few.mp4", 2), 6, candidates, max_side_px=99)
    assert numbers(few) == [0, 1]
    assert few.notes == ("6 frames were asked for, 2 are there",)


def test_candidates_of_a_long_video_are_bounded_spread_and_true(tmp_path: Path) -> None:
    path = numbered_video(tmp_path / "l.mp4", 250, size=(96, 64), group=10)
    frames = read_frames(path, ReadLimits(max_frames=12, max_side_px=96))
    assert len(frames) == 12
    assert frames.n_source_frames == 250
    assert numbers(frames) == frames.indices.tolist()
    stretch = frames.indices * 12 // 250
    assert stretch.tolist() == list(range(12))
    with av.open(str(path)) as container:
        times = [p.pts * p.time_base for p in container.demux(video=0) if p.is_keyframe and p.pts is not None]
    keys = {round(30 * time) for time in times}
    assert set(frames.indices.tolist()) <= keys  # a group is shorter than a stretch of 250 / 12 frames


@pytest.mark.parametrize("codec", ["libx264", "libx265", "mpeg4"])
def test_explicit_frames_are_exact_with_b_frames_and_seeks(tmp_path: Path, codec: str) -> None:
    name = "x.avi" if codec == "mpeg4" else "x.mp4"
    path = numbered_video(tmp_path / name, 120, size=(96, 64), group=25, codec=codec)
    wanted = [0, 1, 24, 25, 26, 74, 99, 119]
    frames = read_frames(path, ReadLimits(max_frames=2, max_side_px=96), indices=wanted[::-1])
    assert numbers(frames) == frames.indices.tolist() == wanted


@pytest.mark.parametrize(
    ("indices", "part"), [([3, 9], "frame 9"), ([-1], "frame -1"), ([2, 2], "twice"), ([], "no frame")]
)
def test_explicit_frames_are_validated(tmp_path: Path, indices: list[int], part: str) -> None:
    path = numbered_video(tmp_path / "x.mp4", 5)
    with pytest.raises(ModelError) as error:
        read_frames(path, ALL, indices=indices)
    one_line(error, part, "0..4", "--frames")


def test_varying_rate_keeps_true_times(tmp_path: Path) -> None:
    times = [0, 1, 2, 10, 11, 40]
    path = numbered_video(tmp_path / "v.mkv", 6, times=times)
    frames = read_frames(path, ALL)
    assert numbers(frames) == list(range(6))
    np.testing.assert_allclose([frame.time_s for frame in frames.frames], np.array(times) / 30, atol=1e-3)


def test_raw_stream_without_timestamps(tmp_path: Path) -> None:
    path = numbered_video(tmp_path / "raw.h264", 30, container_format="h264")
    frames = read_frames(path, ReadLimits(max_frames=6, max_side_px=160))
    assert numbers(frames) == frames.indices.tolist()
    assert len(frames) == 6


def test_transparent_video_lies_over_black(tmp_path: Path) -> None:
    rgba = np.full((64, 96, 4), 255, np.uint8)
    rgba[:, 48:, 3] = 0
    path = write_video(tmp_path / "t.mov", [rgba] * 3, codec="prores_ks", pix_fmt="yuva444p10le")
    frames = read_frames(path, ALL)
    assert frames.images[0][:, :46].min() > 245
    assert frames.images[0][:, 50:].max() < 10
    assert any("transparency" in change for change in frames.changes)


def test_oblong_pixels_are_made_square(tmp_path: Path) -> None:
    path = numbered_video(tmp_path / "s.mp4", 3, pixel_ratio=Fraction(4, 3))
    frames = read_frames(path, ALL)
    assert frames.images[0].shape == (96, 213, 3)
    assert frames.frames[0].source_size == (213, 96)
    assert numbers(frames) == [0, 1, 2]


def test_high_dynamic_range_is_brought_to_bt709(tmp_path: Path) -> None:
    grey = np.full((64, 96, 3), 128, np.uint8)
    path = write_video(
        tmp_path / "h.mov", [grey] * 3, codec="libx265", pix_fmt="yuv420p10le", hdr_transfer=18
    )
    frames = read_frames(path, ALL)
    assert any("HLG" in change for change in frames.changes)
    assert frames.images[0].mean() > 135  # HLG's middle grey is brighter on an ordinary screen


def test_one_frame_works_and_says_so(tmp_path: Path) -> None:
    frames = read_frames(numbered_video(tmp_path / "1.mp4", 1), ALL)
    assert numbers(frames) == [0]
    assert any("one frame only" in note for note in frames.notes)


def truncated(path: Path, share: float) -> Path:
    data = path.read_bytes()
    cut = path.with_stem("cut")
    cut.write_bytes(data[: int(len(data) * share)])
    return cut


def test_recording_cut_off_before_its_index(tmp_path: Path) -> None:
    path = truncated(numbered_video(tmp_path / "a.mp4", 30), 0.7)  # the index of an mp4 comes last
    with pytest.raises(ModelError) as error:
        read_frames(path, ALL)
    one_line(error, "cut.mp4", "not a video that can be read", "no index", "cut off")


@pytest.mark.parametrize(
    ("name", "options"), [("a.mp4", {"movflags": "+faststart"}), ("a.mkv", {}), ("a.avi", {}), ("a.webm", {})]
)
def test_cut_video_gives_what_is_there_and_counts(tmp_path: Path, name: str, options: dict[str, str]) -> None:
    rng = np.random.default_rng(1)
    noisy = [
        np.where(rng.random((96, 160, 1)) < 0.3, rng.integers(0, 60, (96, 160, 3)), numbered_frame(i)).astype(
            np.uint8
        )
        for i in range(40)
    ]
    codec = {"a.avi": "mpeg4", "a.webm": "libvpx-vp9"}.get(name, "libx264")
    whole = write_video(tmp_path / name, noisy, codec=codec, container_options=options)
    assert read_frames(whole, ALL).notes == ()
    frames = read_frames(truncated(whole, 0.6), ALL)
    assert 5 <= len(frames) < 36
    for frame in frames.frames:
        smooth = cv2.medianBlur(frame.image, 5)
        assert abs(frame.image.astype(float).mean() - noisy[frame.index].mean()) < 4
        assert number_of(cv2.resize(smooth, (8, 24), interpolation=cv2.INTER_AREA)) == frame.index
    if name == "a.mp4":
        assert any("40" in note for note in frames.notes)  # the header announces more


def test_damage_in_the_middle_costs_frames_never_wrong_ones(tmp_path: Path) -> None:
    path = numbered_video(tmp_path / "a.mp4", 100, size=(320, 192), group=10, options={"crf": "10"})
    data = bytearray(path.read_bytes())
    start = data.find(b"mdat") + 4
    end = data.find(b"moov")
    middle = (start + end) // 2
    data[middle : middle + (end - start) // 20] = bytes((end - start) // 20)
    path.write_bytes(bytes(data))
    frames = read_frames(path, ALL)
    lost = 100 - len(frames)
    assert lost < 40
    good = [frame.index == number_of(frame.image) for frame in frames.frames]
    assert np.mean(good) > 0.85  # a decoder conceals what it can without saying so
    if lost:
        assert any(f"{lost} of 100" in note for note in frames.notes)


@pytest.mark.parametrize(
    ("name", "content", "parts"),
    [
        ("empty.mp4", b"", ("empty.mp4", "0 bytes")),
        ("text.mp4", b"this is a shopping list\n" * 50, ("text.mp4", "not a video")),
        ("noise.mov", bytes(range(256)) * 40, ("noise.mov", "not a video")),
    ],
)
def test_files_that_are_no_videos(tmp_path: Path, name: str, content: bytes, parts: tuple[str, ...]) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ModelError) as error:
        read_frames(tmp_path / name, ALL)
    one_line(error, *parts)


@pytest.mark.parametrize("name", ["none.mp4", "none.mov", "none.mkv", "none.avi"])
def test_video_of_zero_length(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
        container.start_encoding()
    with pytest.raises(ModelError) as error:
        read_frames(path, ALL)
    one_line(error, name, "zero length")


def test_sound_is_not_a_video(tmp_path: Path) -> None:
    path = tmp_path / "song.m4a"
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 2048), np.float32), format="fltp", layout="mono")
        frame.rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.raises(ModelError) as error:
        read_frames(path, ALL)
    one_line(error, "song.m4a", "audio, but no video")


def test_unknown_codec(tmp_path: Path) -> None:
    """A well-formed file whose codec FFmpeg does not know."""
    path = numbered_video(tmp_path / "u.mp4", 3)
    path.write_bytes(path.read_bytes().replace(b"avc1", b"zzz9").replace(b"avcC", b"zzzC"))
    with pytest.raises(ModelError) as error:
        read_frames(path, ALL)
    one_line(error, "u.mp4", "codec")


def test_missing_file_suggests_its_neighbour(tmp_path: Path) -> None:
    numbered_video(tmp_path / "clip_mug.mp4", 2)
    with pytest.raises(ModelError) as error:
        read_frames(tmp_path / "clip_mugg.mp4", ALL)
    one_line(error, "no such file", "Did you mean", "clip_mug.mp4")


def test_a_pipe_is_no_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "clip.mp4")
    with pytest.raises(ModelError) as error:
        read_frames(tmp_path / "clip.mp4", ALL)
    one_line(error, "neither a file nor a folder", "Check the path.")


@pytest.mark.parametrize("changes", [{"max_frames": 0}, {"max_side_px": 0}])
def test_limits_are_checked(changes: dict[str, int]) -> None:
    with pytest.raises(ModelError, match="too small"):
        ReadLimits(**({"max_frames": 4, "max_side_px": 4} | changes))


@pytest.mark.parametrize("name", ["f.mp4", "f.mkv", "f.avi", "f.gif"])
def test_any_damage_ends_in_frames_or_in_a_model_error(tmp_path: Path, name: str) -> None:
    """Forty damaged copies of each: bytes overwritten anywhere, also in the header and in titles."""
    codec, pix_fmt = {"f.avi": ("mpeg4", "yuv420p"), "f.gif": ("gif", "rgb8")}.get(
        name, ("libx264", "yuv420p")
    )
    data = numbered_video(tmp_path / name, 12, size=(64, 48), codec=codec, pix_fmt=pix_fmt).read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(40):
        damaged = bytearray(data)
        for place in rng.integers(0, len(data), rng.integers(1, 20)):
            damaged[place] = rng.integers(0, 256)
        (tmp_path / name).write_bytes(damaged)
        try:
            frames = read_frames(tmp_path / name, ReadLimits(max_frames=8, max_side_px=64))
        except ModelError:
            continue
        assert 1 <= len(frames) <= 8
