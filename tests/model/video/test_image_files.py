"""Folders of images and single ones: upright 8-bit RGB in natural order, and a name for what is broken."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from model.errors import ModelError
from model.video.frames import ReadLimits
from model.video.image_files import natural_key
from model.video.reading import read_frames
from tests.model.video.encoded_videos import corner_is_red, numbered_frame, numbers

ALL = ReadLimits(max_frames=256, max_side_px=2048)
EXIF_ORIENTATION = 0x0112


def save(path: Path, pixels: np.ndarray, **settings: object) -> Path:
    Image.fromarray(pixels).save(path, **settings)  # type: ignore[arg-type]
    return path


def test_natural_order_and_formats(tmp_path: Path) -> None:
    for number, suffix in ((10, "png"), (9, "jpg"), (2, "webp"), (1, "JPEG"), (100, "png")):
        save(tmp_path / f"frame_{number}.{suffix}", numbered_frame(number), quality=95)
    (tmp_path / "notes.txt").write_text("camera 3")
    (tmp_path / ".DS_Store").write_bytes(b"x")
    (tmp_path / "masks").mkdir()
    frames = read_frames(tmp_path, ALL)
    assert numbers(frames) == [1, 2, 9, 10, 100]
    assert [frame.name for frame in frames.frames][:2] == ["frame_1.JPEG", "frame_2.webp"]
    assert all(math.isnan(frame.time_s) for frame in frames.frames)
    assert frames.notes == ("files that are no images were not read: 1 .txt",)


def test_natural_key_never_compares_text_with_numbers() -> None:
    names = ["b", "10", "a10b2", "a2", "2", "a10b", "a", "A3"]
    ordered = [path.name for path in sorted(map(Path, names), key=natural_key)]
    assert ordered == ["2", "10", "a", "a2", "A3", "a10b", "a10b2", "b"]


def test_many_images_are_thinned_evenly_and_indices_are_exact(tmp_path: Path) -> None:
    for number in range(40):
        save(tmp_path / f"{number}.png", numbered_frame(number, (64, 48)))
    frames = read_frames(tmp_path, ReadLimits(max_frames=8, max_side_px=64))
    assert numbers(frames) == frames.indices.tolist() == [2, 7, 12, 17, 22, 27, 32, 37]
    frames = read_frames(tmp_path, ReadLimits(max_frames=2, max_side_px=64), indices=[39, 0, 11])
    assert numbers(frames) == [0, 11, 39]
    with pytest.raises(ModelError, match=r"frame 40 does not exist.*0\.\.39"):
        read_frames(tmp_path, ALL, indices=[40])


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_respected(tmp_path: Path, orientation: int) -> None:
    """Stored as a phone stores it, shown as the scene was."""
    scene = numbered_frame(77, (160, 96))
    stored = {
        1: scene,
        2: scene[:, ::-1],
        3: np.rot90(scene, 2),
        4: scene[::-1],
        5: scene.swapaxes(0, 1),
        6: np.rot90(scene, 1),
        7: scene[::-1, ::-1].swapaxes(0, 1),
        8: np.rot90(scene, -1),
    }[orientation]
    exif = Image.Exif()
    exif[EXIF_ORIENTATION] = orientation
    path = save(tmp_path / "p.jpg", np.ascontiguousarray(stored), exif=exif, quality=95)
    frames = read_frames(path, ALL)
    assert frames.images[0].shape == scene.shape
    assert frames.frames[0].source_size == (160, 96)
    assert corner_is_red(frames.images[0])
    assert numbers(frames) == [77]
    assert any("EXIF" in change for change in frames.changes) == (orientation != 1)


def test_turned_large_jpeg_is_scaled_and_keeps_its_source_size(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[EXIF_ORIENTATION] = 6
    stored = np.ascontiguousarray(np.rot90(numbered_frame(9, (1200, 1600)), 1))
    frame = read_frames(
        save(tmp_path / "p.jpg", stored, exif=exif), ReadLimits(max_frames=1, max_side_px=200)
    ).frames[0]
    assert frame.image.shape == (200, 150, 3)
    assert frame.source_size == (1200, 1600)
    assert corner_is_red(frame.image)


def test_grey_alpha_and_16_bit_become_8_bit_rgb(tmp_path: Path) -> None:
    values = np.linspace(0, 65535, 64).astype(np.uint16)
    ramp = np.repeat(values[None], 48, axis=0)
    expected = (ramp / 257.0)[..., None]
    cv2.imwrite(str(tmp_path / "1_grey16.png"), ramp)
    cv2.imwrite(str(tmp_path / "2_rgb16.png"), np.repeat(ramp[..., None], 3, axis=-1))
    save(tmp_path / "3_grey8.png", (ramp >> 8).astype(np.uint8))
    save(tmp_path / "4_grey8.jpg", (ramp >> 8).astype(np.uint8), quality=95)
    frames = read_frames(tmp_path, ALL)
    for image in frames.images:
        assert image.shape == (48, 64, 3)
        assert np.abs(image - expected).max() <= 4
    assert "grey copied to three channels (3 of 4 frames)" in frames.changes


@pytest.mark.parametrize("depth", [8, 16])
def test_transparency_lies_over_black(tmp_path: Path, depth: int) -> None:
    rgba = np.zeros((32, 32, 4), np.uint16)
    rgba[:] = (200, 100, 50, 255)
    rgba[:16, :, 3] = 128
    rgba[:, :16, 3] = 0
    stored = rgba if depth == 8 else rgba * 257
    cv2.imwrite(
        str(tmp_path / "a.png"), stored[..., [2, 1, 0, 3]].astype(np.uint8 if depth == 8 else np.uint16)
    )
    frames = read_frames(tmp_path / "a.png", ALL)
    image = frames.images[0].astype(int)
    assert image[:, :16].max() == 0
    np.testing.assert_allclose(image[16:, 16:].reshape(-1, 3), np.tile([200, 100, 50], (256, 1)), atol=1)
    np.testing.assert_allclose(image[:16, 16:].reshape(-1, 3), np.tile([100, 50, 25], (256, 1)), atol=1)
    assert any("transparency" in change for change in frames.changes)


def test_palette_with_a_transparent_colour(tmp_path: Path) -> None:
    palette_image = Image.new("P", (8, 8), 1)
    palette_image.putpalette([255, 255, 255, 10, 200, 30])
    palette_image.paste(0, (0, 0, 4, 8))
    palette_image.save(tmp_path / "p.png", transparency=0)
    image = read_frames(tmp_path / "p.png", ALL).images[0]
    assert image[:, :4].max() == 0
    assert tuple(image[0, 6]) == (10, 200, 30)


def test_mixed_sizes_are_allowed(tmp_path: Path) -> None:
    """Each image is cropped on its own."""
    save(tmp_path / "1.png", numbered_frame(1, (160, 96)))
    save(tmp_path / "2.png", numbered_frame(2, (80, 120)))
    frames = read_frames(tmp_path, ALL)
    assert [image.shape for image in frames.images] == [(96, 160, 3), (120, 80, 3)]


def test_single_image_says_what_it_lacks(tmp_path: Path) -> None:
    frames = read_frames(save(tmp_path / "mug.png", numbered_frame(3)), ALL)
    assert numbers(frames) == [3]
    assert any("one frame only" in note for note in frames.notes)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
@pytest.mark.parametrize("share", [0.0, 0.05, 0.6])
def test_cut_image_is_named(tmp_path: Path, suffix: str, share: float) -> None:
    save(tmp_path / f"1.{suffix}", numbered_frame(1))
    noise = np.random.default_rng(0).integers(0, 256, (96, 160, 3), dtype=np.uint8)
    path = save(tmp_path / f"2.{suffix}", noise)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ModelError) as error:
        read_frames(tmp_path, ALL)
    assert f"2.{suffix}: the image cannot be read" in str(error.value)
    assert "\n" not in str(error.value)


def test_text_that_is_called_a_image(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text("hello")
    with pytest.raises(ModelError, match=r"a\.png: the image cannot be read: not an image"):
        read_frames(tmp_path, ALL)


def test_folders_without_images(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="it is empty"):
        read_frames(tmp_path, ALL)
    for name in ("a.heic", "b.heic", "c.txt"):
        (tmp_path / name).write_bytes(b"x")
    with pytest.raises(ModelError, match=r"no images in this folder \(2 \.heic, 1 \.txt\)"):
        read_frames(tmp_path, ALL)
