"""Folders of images and single ones: upright 8-bit RGB in natural order, and a name for what is broken."""

import math
import struct
import warnings
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from model.errors import ModelError
from model.video.frames import ReadLimits
from model.video.image_listing import natural_key
from model.video.reading import read_frames
from tests.model.video.encoded_videos import (
    corner_is_red,
    exif,
    numbered_frame,
    numbered_video,
    numbers,
    stored_for,
)

ALL = ReadLimits(max_frames=256, max_side_px=2048)


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


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "avif", "tif", "apng"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_respected(tmp_path: Path, orientation: int, suffix: str) -> None:
    """Stored as a phone stores it, shown as the scene was."""
    scene = numbered_frame(77, (160, 96))
    settings: dict[str, object] = {"exif": exif(orientation), "quality": 95}
    if suffix == "apng":
        other = Image.fromarray(stored_for(numbered_frame(78), orientation))
        settings |= {"format": "PNG", "save_all": True, "append_images": [other], "duration": 40}
    if suffix == "webp":
        settings |= {"lossless": True}
    path = save(tmp_path / f"p.{suffix}", stored_for(scene, orientation), **settings)
    frames = read_frames(path, ALL)
    assert numbers(frames) == ([77, 78] if suffix == "apng" else [77])
    for frame in frames.frames:
        assert frame.image.shape == scene.shape
        assert frame.source_size == (160, 96)
        assert corner_is_red(frame.image)


def test_turns_that_differ_are_told_and_broken_ones_ignored(tmp_path: Path) -> None:
    for number, orientation in enumerate((1, 6, 8, 0, 99)):
        stored = stored_for(numbered_frame(number), orientation if orientation in range(1, 9) else 1)
        save(tmp_path / f"{number}.jpg", stored, exif=exif(orientation), quality=95)
    broken = b"Exif\0\0II*\0\x08\0\0\0\x07\0\x12\x01"
    save(tmp_path / "5.jpg", numbered_frame(5), exif=broken, quality=95)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        frames = read_frames(tmp_path, ALL)
    assert numbers(frames) == [0, 1, 2, 3, 4, 5]
    assert all(corner_is_red(image) for image in frames.images)
    assert frames.notes == (
        "2 of 6 images: turned upright as EXIF data say; the others are as they are stored",
    )


def test_turned_large_jpeg_is_scaled_and_keeps_its_source_size(tmp_path: Path) -> None:
    stored = stored_for(numbered_frame(9, (1200, 1600)), 6)
    frame = read_frames(
        save(tmp_path / "p.jpg", stored, exif=exif(6)), ReadLimits(max_frames=1, max_side_px=200)
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
def test_cut_image_is_left_out_and_named(tmp_path: Path, suffix: str, share: float) -> None:
    save(tmp_path / f"1.{suffix}", numbered_frame(1))
    noise = np.random.default_rng(0).integers(0, 256, (96, 160, 3), dtype=np.uint8)
    path = save(tmp_path / f"2.{suffix}", noise)
    save(tmp_path / f"3.{suffix}", numbered_frame(3))
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    frames = read_frames(tmp_path, ALL)
    assert numbers(frames) == [1, 3]
    assert frames.indices.tolist() == [0, 2]
    note = f"1 of 3 images are left out: 2.{suffix}: the image cannot be read: "
    assert len(frames.notes) == 1
    assert frames.notes[0].startswith(note)
    for source, indices in ((tmp_path, [1]), (path, None)):
        with pytest.raises(ModelError) as error:
            read_frames(source, ALL, indices=indices)
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
    with pytest.raises(ModelError, match=r"no images in this folder \(2 \.heic, 1 \.txt\).*Convert to JPEG"):
        read_frames(tmp_path, ALL)
    numbered_video(tmp_path / "b.MOV", 2)  # a Live Photo
    with pytest.raises(ModelError, match=r"no images in this folder .*Name the video: .*b\.MOV\."):
        read_frames(tmp_path, ALL)


HEIC = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(100)


@pytest.mark.parametrize("name", ["a.heic", "a.HEIF", "a.jpg", "a"])
def test_heic_is_named_whatever_its_suffix(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(HEIC)
    with pytest.raises(ModelError, match=r"a HEIC image, which is not decoded here; .*Convert to JPEG"):
        read_frames(tmp_path / name, ALL)
    numbered_video(tmp_path / "a.mov", 2)
    with pytest.raises(ModelError, match=r"Name the video beside it, a\.mov\."):
        read_frames(tmp_path / name, ALL)


def test_heic_among_other_images(tmp_path: Path) -> None:
    save(tmp_path / "1.jpg", numbered_frame(1), quality=95)
    (tmp_path / "2.heic").write_bytes(HEIC)
    (tmp_path / "3.jpg").write_bytes(HEIC)
    save(tmp_path / "4.heic", numbered_frame(4), format="JPEG", quality=95)  # as chats rename them
    frames = read_frames(tmp_path, ALL)
    assert numbers(frames) == [1, 4]
    assert len(frames.notes) == 1
    assert frames.notes[0].startswith("2 HEIC images were not read (2.heic, ...)")


def test_links_and_hidden_files(tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    save(elsewhere / "x.png", numbered_frame(2))
    folder = tmp_path / "frames"
    folder.mkdir()
    save(folder / "1.png", numbered_frame(1))
    (folder / "2.png").symlink_to(elsewhere / "x.png")
    (folder / "3.png").symlink_to(elsewhere / "gone.png")
    (folder / "._1.png").write_bytes(b"\0\5\x16\7")
    (tmp_path / "link").symlink_to(folder)
    frames = read_frames(tmp_path / "link", ALL)
    assert numbers(frames) == [1, 2]
    assert frames.notes == ("links that lead nowhere, and other things that are no files: 3.png",)


@pytest.mark.parametrize("suffix", ["png", "webp", "avif", "apng"])
def test_animated_images_are_films(tmp_path: Path, suffix: str) -> None:
    images = [Image.fromarray(numbered_frame(number)) for number in range(7)]
    form = {"webp": "WEBP", "avif": "AVIF"}.get(suffix, "PNG")
    settings = {"lossless": True} if suffix == "webp" else {"quality": 95}
    durations = [100, 50, 200, 100, 100, 100, 100]
    path = tmp_path / f"a.{suffix}"
    images[0].save(path, format=form, save_all=True, append_images=images[1:], duration=durations, **settings)
    frames = read_frames(path, ALL)
    assert (frames.kind, frames.n_source_frames, frames.notes) == ("video", 7, ())
    assert numbers(frames) == list(range(7))
    np.testing.assert_allclose(
        [frame.time_s for frame in frames.frames], [0, 0.1, 0.15, 0.35, 0.45, 0.55, 0.65]
    )
    assert numbers(read_frames(path, ALL, indices=[5, 2])) == [2, 5]
    save(tmp_path / "b.png", numbered_frame(9))
    frames = read_frames(tmp_path, ALL)
    assert numbers(frames) == [0, 9]
    assert frames.notes == ("only the first image of the file used (1 of 2 frames)",)


def test_cut_animation_gives_what_is_there(tmp_path: Path) -> None:
    images = [Image.fromarray(numbered_frame(number)) for number in range(8)]
    path = tmp_path / "a.png"
    images[0].save(path, save_all=True, append_images=images[1:], duration=40)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    frames = read_frames(path, ALL)
    assert 2 <= len(frames) < 8
    assert numbers(frames) == list(range(len(frames)))
    assert frames.notes == (f"{8 - len(frames)} of 8 candidate frames cannot be decoded and are left out",)
    with pytest.raises(ModelError, match=r"a\.png: the image cannot be read: damaged"):
        read_frames(path, ALL, indices=[0, 7])


def test_the_still_of_an_animated_png_is_not_a_frame(tmp_path: Path) -> None:
    """What viewers show that know no animation."""
    images = [Image.fromarray(numbered_frame(number)) for number in (99, 0, 1)]
    images[0].save(
        tmp_path / "a.png", save_all=True, append_images=images[1:], default_image=True, duration=40
    )
    assert numbers(read_frames(tmp_path / "a.png", ALL)) == [0, 1]


@pytest.mark.parametrize("name", ["photo", "photo.png", "photo.mp4"])
def test_content_decides_not_the_suffix(tmp_path: Path, name: str) -> None:
    frames = read_frames(save(tmp_path / name, numbered_frame(5), format="JPEG", quality=95), ALL)
    assert frames.kind == "images"
    assert numbers(frames) == [5]


@pytest.mark.parametrize("suffix", ["bmp", "tif", "mpo"])
def test_other_formats(tmp_path: Path, suffix: str) -> None:
    settings: dict[str, object] = {}
    if suffix == "mpo":
        settings = {"save_all": True, "append_images": [Image.fromarray(numbered_frame(99))], "quality": 95}
    frames = read_frames(save(tmp_path / f"a.{suffix}", numbered_frame(5), **settings), ALL)
    assert numbers(frames) == [5]
    assert frames.notes == ("one frame only: sides that it does not show are guessed",)


def test_numbers_of_unknown_range_are_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "depth.tif", np.linspace(0, 1, 48 * 64, dtype=np.float32).reshape(48, 64))
    with pytest.raises(ModelError, match=r"depth\.tif: .*floating-point numbers of unknown range"):
        read_frames(path, ALL)


def test_formats_that_run_programs_are_not_tried(tmp_path: Path) -> None:
    """Pillow hands EPS to Ghostscript."""
    (tmp_path / "a.png").write_bytes(
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\nshowpage\n"
    )
    with pytest.raises(ModelError, match=r"a\.png: the image cannot be read: not an image"):
        read_frames(tmp_path / "a.png", ALL)


@pytest.mark.parametrize(
    ("side", "found"), [(12000, "12000 x 12000 pixels"), (30000, "more than 179 megapixels")]
)
def test_images_too_large_to_decode(tmp_path: Path, side: int, found: str) -> None:
    """A header of a few bytes may ask for gigabytes."""
    data = bytearray(save(tmp_path / "a.png", np.zeros((1, 1, 3), np.uint8)).read_bytes())
    data[16:24] = struct.pack(">II", side, side)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    (tmp_path / "a.png").write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ModelError, match=f"{found}; expected at most 134 megapixels"):
            read_frames(tmp_path / "a.png", ALL)
