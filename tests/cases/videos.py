"""Videos and images that a user reconstructs from: every frame in its order, upright, in its colours; or a line."""

import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from model.errors import ModelError
from model.video.frame_choice import choose_frames
from model.video.frames import ReadLimits, VideoFrames
from model.video.reading import read_frames, read_informative_frames
from tests.cases.outcome import Case

__all__ = ["CASES"]

ALL = ReadLimits(max_frames=64, max_side_px=512)

# The scene of most files: four quarters, and a white square that moves to the right over their corner.
QUARTERS = np.array([[(200, 40, 40), (40, 180, 40)], [(40, 40, 200), (210, 200, 40)]])


def frames_of(source: str | Path, n: int) -> VideoFrames:
    """All frames of a source, which must be n."""
    frames = read_frames(source, ALL)
    assert len(frames) == frames.n_source_frames == n, f"{source}: {len(frames)} of {frames.n_source_frames}"
    return frames


def assert_scene(frames: VideoFrames, tolerance: int = 8) -> None:
    """Quarters in their places and colours, also where a square passes."""
    for frame in frames.frames:
        height, width = frame.image.shape[:2]
        for row, column in np.ndindex(2, 2):
            y, x = (1 + 2 * row) * height // 4, (1 + 2 * column) * width // 4
            patch = frame.image[y - 2 : y + 3, x - 2 : x + 3].reshape(-1, 3).mean(axis=0)
            error = np.abs(patch - QUARTERS[row, column]).max()
            assert error <= tolerance, f"{frame.name}: {patch.round()} at ({x}, {y})"


def assert_moves_right(frames: VideoFrames) -> None:
    """Frames in their order."""
    x = [square_x(image) for image in frames.images]
    assert all(later > earlier for earlier, later in pairwise(x)), x


def square_x(image: np.ndarray) -> float:
    """Centre of what is white, px."""
    white = np.flatnonzero((image.min(axis=-1) > 170).sum(axis=0) > 2)
    assert len(white), "no white square"
    return float(white.mean())


def times_s(frames: VideoFrames) -> list[float]:
    return [frame.time_s for frame in frames.frames]


def noted(frames: VideoFrames, part: str) -> str:
    """The note that holds `part`."""
    notes = [note for note in frames.notes if part in note]
    assert len(notes) == 1, f"no single note on '{part}': {frames.notes}"
    return notes[0]


def refusal(source: str | Path, *parts: str) -> str:
    """The line in which it is refused."""
    try:
        frames = read_frames(source, ALL)
    except ModelError as error:
        line = str(error)
        assert "\n" not in line
        for part in parts:
            assert part in line, line
        return line
    raise AssertionError(f"{source}: {len(frames)} frames were read")


@contextmanager
def inside(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def film(source: str | Path, n: int = 24) -> VideoFrames:
    """The scene with its square, in n frames."""
    frames = frames_of(source, n)
    assert_scene(frames)
    assert_moves_right(frames)
    return frames


def names_with_colons(folder: Path) -> str:
    names = sorted(path.name for path in folder.glob("*.mp4"))
    with inside(folder):
        for name in names:
            assert film(name).notes == ()
    return f"{len(names)} names read from inside their folder"


def odd_names(folder: Path) -> str:
    files = [path for path in folder.iterdir() if path.name != "README"]
    with inside(folder):
        for path in files:
            film(path.name)
    return f"{len(files)} names read"


def varying_rate(folder: Path) -> str:
    truth_ms = json.loads((folder / "times.json").read_text())
    np.testing.assert_allclose(times_s(film(folder / "vfr.mkv")), np.array(truth_ms) / 1000.0, atol=1e-3)
    return "24 frames at their times"


def odd_sizes(folder: Path) -> str:
    frames = frames_of(folder / "odd444.mp4", 6)
    assert_scene(frames)
    assert frames.images[0].shape == (121, 161, 3)
    assert frames_of(folder / "tiny.mkv", 6).images[0].shape == (2, 33, 3)
    return "161 x 121 and 33 x 2"


def alpha(folder: Path) -> str:
    frames = frames_of(folder / "alpha.webm", 8)
    for image in frames.images:
        assert image[:, :76].max() <= 10, "the transparent half is not black"
        assert np.abs(image[20:50, 90:150].reshape(-1, 3).mean(axis=0) - QUARTERS[0, 1]).max() <= 8
    return noted(frames, "transparency laid over black")


def ten_bits(folder: Path) -> str:
    film(folder / "ten.mp4", 8)
    start = time.process_time()
    frames, _ = read_informative_frames(folder / "hlg.mp4", 6, ALL, max_side_px=2048)
    seconds = time.process_time() - start
    assert seconds <= 1.0, f"{seconds:.1f} s"
    assert len(frames) == 6
    assert any("HLG" in change for change in frames.changes), frames.changes
    assert_moves_right(frames)
    return f"6 of 8 HLG frames in {seconds:.2f} s of one core"


def animated(folder: Path) -> str:
    for name in ("a.apng", "a.gif", "a.png", "a.webp"):
        frames = frames_of(folder / name, 8)
        assert_scene(frames)
        assert_moves_right(frames)
        assert times_s(frames)[0] == 0.0
        assert np.diff(times_s(frames)).min() > 0.0
    return "8 frames with their times of APNG, GIF, PNG and WebP"


def kinds_of_images(folder: Path) -> str:
    frames = frames_of(folder, 8)
    grey = frames.select([1])
    assert grey.frames[0].name == "02_grey.JPG"
    assert np.ptp(grey.images[0], axis=-1).max() == 0
    assert_scene(frames.select([0, 2, 3, 4, 5, 6, 7]), tolerance=16)  # CMYK has a smaller gamut
    return f"8 images; {noted(frames, 'no images')}"


def heic_folder(folder: Path) -> str:
    return refusal(folder, "3 .heic", "Convert to JPEG")


def heic_image(folder: Path) -> str:
    return refusal(folder / "IMG_0001.HEIC", "HEIC image", "Convert to JPEG")


def interlaced(folder: Path) -> str:
    for name in ("interlaced.mp4", "interlaced.mpg"):
        frames = frames_of(folder / name, 12)
        assert_scene(frames)
        noted(frames, "deinterlaced")
        for image in frames.images:
            assert comb(image) < 8.0, f"{name}: combs of {comb(image):.1f}"
    return "12 frames without combs, noted"


def comb(image: np.ndarray) -> float:
    """How much more a row differs from its neighbour than from the row after: 0 without combs."""
    luma = image.astype(float).mean(axis=-1)
    near, far = np.abs(np.diff(luma, axis=0))[:-1], np.abs(luma[2:] - luma[:-2])
    return float(np.maximum(near - far, 0.0).reshape(len(near), -1).mean(axis=1).max())


def one_frame(folder: Path) -> str:
    for name in ("one.mp4", "one.png"):
        frames = frames_of(folder / name, 1)
        assert_scene(frames)
        noted(frames, "one frame only")
    return "one frame, noted"


def full_range(folder: Path) -> str:
    frames = frames_of(folder / "cam.avi", 8)
    assert_scene(frames, tolerance=6)
    grey = frames_of(folder / "grey.mkv", 8).images[0]
    assert np.ptp(grey, axis=-1).max() == 0
    return "colours within 6"


def repeated_times(folder: Path) -> str:
    film(folder / "intra.mkv")
    return "24 frames in the order in which they were filmed"


def two_streams(folder: Path) -> str:
    return noted(film(folder / "drone.mp4"), "2 video streams")


def mixed_orientations(folder: Path) -> str:
    """Every file stores the scene; 6 is shown turned clockwise, 8 against the clock, 3 upside down."""
    turns = {"0.jpg": 1, "1.jpg": -1, "2.jpg": 2, "7_png_with_exif.png": 1}
    frames = frames_of(folder, 8)
    stored = [
        replace(frame, image=np.rot90(frame.image, turns.get(frame.name, 0))) for frame in frames.frames
    ]
    assert_scene(replace(frames, frames=tuple(stored)))
    return noted(frames, "EXIF")


def gaps_and_damage(folder: Path) -> str:
    frames = read_frames(folder, ALL)
    names = [frame.name for frame in frames.frames]
    assert names == [name for name in ("frame_1.jpg", "frame_2.jpg", "frame_10.jpg") if name in names]
    assert_scene(frames)
    left_out = [note for note in frames.notes if "left out" in note]
    assert len(names) + len(left_out) == 3
    return f"{', '.join(names)}; {'; '.join(left_out) or 'none is damaged'}"


def unusual_containers(folder: Path) -> str:
    for name, n in (("A.MOV", 24), ("a.ts", 24), ("a.y4m", 8), ("frag.mp4", 24), ("raw.h264", 24)):
        film(folder / name, n)
    assert times_s(read_frames(folder / "a.ts", ALL))[0] == 0.0
    return noted(read_frames(folder / "raw.h264", ALL), "no timestamps")


def negative_start(folder: Path) -> str:
    for name in ("bframes.mp4", "neg.mkv"):
        assert times_s(film(folder / name))[0] == 0.0
    return "24 frames from 0 s"


def full_range_of_sd(folder: Path) -> str:
    for name in ("full.mp4", "rgb.mp4"):
        assert_scene(frames_of(folder / name, 6))
    return "colours within 8"


def long_video(folder: Path) -> str:
    limits = ReadLimits(max_frames=32, max_side_px=64)
    frames = read_frames(folder / "long.mp4", limits)
    assert (len(frames), frames.n_source_frames) == (32, 600)
    np.testing.assert_allclose(times_s(frames), frames.indices / 30.0, atol=1e-3)
    again = read_frames(folder / "long.mp4", limits, indices=frames.indices.tolist())
    for one, other in zip(frames.images, again.images, strict=True):
        np.testing.assert_array_equal(one, other)
    return "32 candidates of 600 frames"


def static(folder: Path) -> str:
    choice = choose_frames(frames_of(folder / "still.mp4", 24), 6)
    assert np.isfinite(choice.sharpness).all()
    assert np.isfinite(choice.novelty).all()
    return f"frames {choice.indices.tolist()} of equal ones"


def exif_in_mjpeg(folder: Path) -> str:
    for name in ("camera.avi", "camera.mkv", "camera.mov", "control.avi"):
        film(folder / name, 8)
    return "8 frames from AVI, MKV and MOV"


def exif_in_apng(folder: Path) -> str:
    film(folder / "a.apng", 6)
    return "6 frames"


def joined_recordings(folder: Path) -> str:
    notes = []
    for name in ("ab_same.ts", "ab_back.ts"):
        frames = frames_of(folder / name, 48)
        red, blue = (np.array([image[..., channel].mean() for image in frames.images]) for channel in (0, 2))
        assert (red[:24] > 100).all(), f"{name}: not red first"
        assert (blue[24:] > 100).all(), f"{name}: not blue second"
        assert (np.diff(red[:24]) > 0).all(), name
        assert (np.diff(blue[24:]) > 0).all(), name
        notes.append(noted(frames, "timestamps"))
    return "; ".join(notes)


ROWS = {
    "v01_colon_in_name": ("':' in names", names_with_colons),
    "v02_odd_names": ("'%', '#', '-', unicode, long names", odd_names),
    "v03_vfr": ("varying rate", varying_rate),
    "v04_odd_size": ("odd sizes", odd_sizes),
    "v05_vp9_alpha": ("transparent WebM", alpha),
    "v06_hevc_10bit": ("HEVC of 10 bits, HLG", ten_bits),
    "v07_animated": ("animated images", animated),
    "v08_pictures": ("kinds of images in a folder", kinds_of_images),
    "v09_heic_only": ("folder of HEIC images", heic_folder),
    "v10_single_heic": ("one HEIC image", heic_image),
    "v11_interlaced": ("interlaced", interlaced),
    "v12_one_frame": ("one frame", one_frame),
    "v13_mjpeg_full_range": ("full range, grey", full_range),
    "v14_duplicate_timestamps": ("timestamps twice or back", repeated_times),
    "v15_two_video_streams": ("a thumbnail as first stream", two_streams),
    "v16_mixed_orientation_folder": ("EXIF turns in a folder, some broken", mixed_orientations),
    "v17_bad_frames_folder": ("folder with gaps", gaps_and_damage),
    "v19_unusual_containers": ("unusual containers", unusual_containers),
    "v20_negative_start": ("negative timestamps", negative_start),
    "v21_full_range_bt601": ("BT.601 of full range, RGB", full_range_of_sd),
    "v22_many_frames_long": ("long video", long_video),
    "v23_static": ("nothing moves", static),
    "v24_mjpeg_frames_with_exif": ("EXIF in motion JPEG", exif_in_mjpeg),
    "v26_apng_with_exif": ("EXIF in APNG", exif_in_apng),
    "v27_concatenated_ts": ("joined transport streams", joined_recordings),
}

CASES: tuple[Case, ...] = tuple(
    Case(folder=folder, what=what, check=check) for folder, (what, check) in ROWS.items()
)
