"""Inspection shows what the shard holds: numbers in the table, labels where the masks are."""

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from rich.console import Console

from datagen.cli.main import main
from datagen.inspection.overlay import OBJECT_COLOR, draw_labels
from datagen.inspection.sheet import contact_sheet
from datagen.inspection.summary import shard_summary
from shards.reader import Shard, open_dataset
from shards.storage.images import Masks
from tests.shards.synthetic import synthetic_dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    return synthetic_dataset(tmp_path_factory.mktemp("data"))


@pytest.fixture
def shard(dataset) -> Shard:
    return open_dataset(dataset).shards[0]


def test_summary_names_every_clip_object_and_file(shard):
    console = Console(width=250, record=True, file=io.StringIO())
    console.print(shard_summary(shard))
    text = console.export_text()
    for clip in shard.clips():
        assert clip.clip_id in text
    for row in shard.objects():
        assert row.object_uid in text
        assert row.licence in text
    assert all(name in text for name in shard.record.files)


def test_sheet_has_two_rows_of_tiles_per_clip(shard):
    clip = shard.clips()[0]
    sheet = contact_sheet(shard, n_clips=2, n_frames=3, tile_px=96)
    tile_height = round(96 * clip.image_height / clip.image_width)
    assert sheet.shape == (2 * (2 * tile_height + 22), 3 * 96, 3)


def test_object_contour_lies_on_the_border_of_its_mask():
    height, width = 60, 80
    square = np.zeros((height, width), bool)
    square[20:41, 30:61] = True
    empty = np.zeros_like(square)
    masks = Masks(
        hand_visible=empty, object_visible=square, hand_amodal=empty,
        object_amodal=square, arm_visible=empty, arm_amodal=empty,
    )  # fmt: skip
    K = np.array([[100.0, 0.0, 40.0], [0.0, 100.0, 30.0], [0.0, 0.0, 1.0]])
    behind = np.diag([1.0, 1.0, 1.0, 1.0])
    behind[2, 3] = -1.0
    image = draw_labels(
        np.zeros((height, width, 3), np.uint8), masks, np.full((21, 2), np.nan), behind, K, 0.1
    )
    drawn = np.all(image == OBJECT_COLOR, axis=-1)
    border = square & ~cv2.erode(square.astype(np.uint8), np.ones((3, 3))).astype(bool)
    assert drawn[border].mean() > 0.95
    assert not image[~cv2.dilate(square.astype(np.uint8), np.ones((5, 5))).astype(bool)].any()


def test_command_writes_sheet_and_video_that_can_be_read(dataset, tmp_path):
    sheet, video = tmp_path / "sheet.png", tmp_path / "clip.mp4"
    arguments = ["inspect", "shard", "0", "--out", str(dataset), "--sheet", str(sheet), "--video", str(video)]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    assert cv2.imread(str(sheet)) is not None
    clip = open_dataset(dataset).shards[0].clips()[0]
    film = cv2.VideoCapture(str(video))
    n_frames = 0
    while film.read()[0]:
        n_frames += 1
    assert n_frames == 4 * clip.n_frames


def test_verify_is_silent_success_and_loud_failure(dataset, tmp_path):
    assert CliRunner().invoke(main, ["verify", str(dataset)]).exit_code == 0
    copy = tmp_path / "copy"
    for path in dataset.rglob("*"):
        if path.is_file():
            target = copy / path.relative_to(dataset)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(path.read_bytes())
    frames = next(copy.rglob("frames.parquet"))
    data = bytearray(frames.read_bytes())
    data[len(data) // 2] ^= 4
    frames.write_bytes(data)
    result = CliRunner().invoke(main, ["verify", str(copy)])
    assert result.exit_code == 1
    assert "frames.parquet" in result.output
