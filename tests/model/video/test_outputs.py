"""What is written: videos that play, masks at source size, folders that appear whole or not at all."""

from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from model.errors import ModelError
from model.video.contact_sheet import Tile, contact_sheet, overlay, write_masks, write_png
from model.video.frames import ReadLimits, VideoFrame
from model.video.mp4 import write_mp4
from model.video.reading import read_frames
from model.video.square_crop import square_window
from model.video.staged_folder import MANIFEST, staged_folder
from tests.model.video.encoded_videos import numbered_frame, numbers

ALL = ReadLimits(max_frames=256, max_side_px=2048)


@pytest.mark.parametrize("size", [(160, 96), (161, 97), (160, 97)])
def test_mp4_round_trip_for_browsers(tmp_path: Path, size: tuple[int, int]) -> None:
    path = tmp_path / "turntable.mp4"
    write_mp4([numbered_frame(i, size) for i in range(12)], path, fps=24.0)
    frames = read_frames(path, ALL)
    assert numbers(frames) == list(range(12))
    np.testing.assert_allclose([frame.time_s for frame in frames.frames], np.arange(12) / 24, atol=1e-3)
    assert frames.images[0].shape[:2] == tuple(side + side % 2 for side in size[::-1])
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")
    data = path.read_bytes()
    assert data.find(b"moov") < data.find(b"mdat")  # plays before it is loaded


def test_mp4_keeps_colours_and_repeats_to_the_bit(tmp_path: Path) -> None:
    frames = np.empty((5, 64, 64, 3), np.uint8)
    frames[:] = (200, 60, 120)
    for name in ("a.mp4", "b.mp4"):
        write_mp4(frames, tmp_path / name, fps=29.97)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()
    image = read_frames(tmp_path / "a.mp4", ALL).images[2]
    assert np.abs(image.astype(int) - frames[0]).max() <= 3


def test_mp4_refuses_nothing_and_mixed_sizes(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="no frames"):
        write_mp4([], tmp_path / "a.mp4", fps=24.0)
    with pytest.raises(ModelError, match="2 sizes"):
        write_mp4([numbered_frame(0, (32, 32)), numbered_frame(0, (32, 64))], tmp_path / "a.mp4", fps=24.0)


def test_masks_are_png_at_source_size(tmp_path: Path) -> None:
    image = np.zeros((45, 80, 3), np.uint8)
    frames = [
        VideoFrame(image=image, index=i, time_s=0.0, name=str(i), source_size=(320, 180), changes=())
        for i in (3, 141)
    ]
    window = square_window((80, 45), None, 64)
    mask = np.zeros((64, 64), np.float32)
    mask[:32] = 1
    paths = write_masks(tmp_path / "masks", frames, [mask, 1 - mask], [window, window])
    assert [path.name for path in paths] == ["000003.png", "000141.png"]
    top, bottom = (cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in paths)
    assert top.shape == (180, 320)
    assert set(np.unique(top)) == {0, 255}
    assert top[:, :70].max() == 0
    assert top[:89, 71:249].min() == 255
    assert top[91:].max() == 0
    assert ((top | bottom)[:, 71:249] == 255).all()


def test_contact_sheet_shows_every_tile(tmp_path: Path) -> None:
    crop = np.full((3, 64, 64), 0.5, np.float32)
    mask = np.zeros((64, 64), np.float32)
    mask[16:48, 16:48] = 0.9
    tinted = overlay(crop, mask)
    assert tuple(tinted[2, 2]) == (128, 128, 128)
    assert tinted[32, 32, 0] > tinted[32, 32, 2] + 30
    assert tuple(tinted[16, 30]) == (255, 120, 0)
    rows = [
        [
            Tile(image=numbered_frame(1), label="frame 1"),
            Tile(image=tinted, label="amodal mask, a long name"),
        ],
        [Tile(image=np.full((10, 10, 3), 200, np.uint8), label="render")],
    ]
    sheet = contact_sheet(rows, 96)
    assert sheet.shape == (2 * (96 + 18 + 4) + 4, 2 * 100 + 4, 3)
    write_png(tmp_path / "sheet.png", sheet)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "sheet.png")), sheet)
    assert sheet[4 + 48 + 118, 4 + 48, 0] == 200  # the render, enlarged


def write_result(out: Path, text: str, *, overwrite: bool, fault: BaseException | None = None) -> None:
    with staged_folder(out, overwrite=overwrite) as folder:
        (folder / "masks").mkdir()
        (folder / "masks" / "0.png").write_text(text)
        (folder / "reconstruction.json").write_text(text)
        if fault:
            raise fault


def refuse_at_once(out: Path, *, overwrite: bool) -> None:
    with staged_folder(out, overwrite=overwrite):
        pytest.fail("work was begun that cannot be kept")


def everything(folder: Path) -> dict[str, str]:
    files = (p for p in sorted(folder.rglob("*")) if p.is_file() and p.name != MANIFEST)
    return {str(p.relative_to(folder)): p.read_text() for p in files}


def test_folder_appears_whole(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "er" / "out"
    with staged_folder(out, overwrite=False) as folder:
        (folder / "object.glb").write_text("new")
        assert not out.exists()
    assert everything(out) == {"object.glb": "new"}
    assert [path.name for path in out.parent.iterdir()] == ["out"]
    assert out.stat().st_mode & 0o777 == 0o755


@pytest.mark.parametrize("fault", [ValueError(), KeyboardInterrupt(), SystemExit()])
def test_failure_leaves_nothing_behind(tmp_path: Path, fault: BaseException) -> None:
    with pytest.raises(type(fault)):
        write_result(tmp_path / "a" / "out", "new", overwrite=True, fault=fault)
    assert list(tmp_path.iterdir()) == []


def test_existing_results_are_refused_unless_overwritten(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write_result(out, "old", overwrite=False)
    with pytest.raises(ModelError, match=r"exists and is not empty.*--overwrite"):
        refuse_at_once(out, overwrite=False)
    with pytest.raises(ValueError, match="stop"):
        write_result(out, "new", overwrite=True, fault=ValueError("stop"))
    assert everything(out)["reconstruction.json"] == "old"
    with staged_folder(out, overwrite=True) as folder:
        (folder / "object.glb").write_text("new")
    assert everything(out) == {"object.glb": "new"}
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_empty_folder_may_be_used(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    write_result(tmp_path / "out", "new", overwrite=False)
    assert len(everything(tmp_path / "out")) == 2


@pytest.mark.parametrize("change", ["added", "edited", "link", "hidden", "no manifest", "damaged manifest"])
def test_nothing_of_anybody_else_is_ever_deleted(tmp_path: Path, change: str) -> None:
    out = tmp_path / "out"
    write_result(out, "old", overwrite=False)
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "data").write_text("x")
    if change == "added":
        (out / "masks" / "thesis.txt").write_text("three years of work")
    elif change == "edited":
        (out / "reconstruction.json").write_text("with my notes")
    elif change == "link":
        (out / "linked").symlink_to(tmp_path / "precious")
    elif change == "hidden":
        (out / ".env").write_text("x")
    elif change == "no manifest":
        (out / MANIFEST).unlink()
    else:
        (out / MANIFEST).write_text("[")
    before = everything(tmp_path)
    with pytest.raises(ModelError, match="was not written by this program"):
        refuse_at_once(out, overwrite=True)
    assert everything(tmp_path) == before


def test_a_file_that_comes_during_the_work_is_kept(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write_result(out, "old", overwrite=False)

    def late() -> None:
        with staged_folder(out, overwrite=True) as folder:
            (folder / "object.glb").write_text("new")
            (out / "late.txt").write_text("x")

    with pytest.raises(ModelError, match=r"'late\.txt' was not written by this program"):
        late()
    assert set(everything(out)) == {"masks/0.png", "reconstruction.json", "late.txt"}
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_files_and_links_are_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "folder")
    for name in ("file", "link"):
        with pytest.raises(ModelError, match="not a folder"):
            refuse_at_once(tmp_path / name, overwrite=True)
    with pytest.raises(ModelError, match="cannot be written"):
        refuse_at_once(tmp_path / "file" / "out", overwrite=True)
