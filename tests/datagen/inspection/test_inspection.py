"""Inspection shows what the shard holds: numbers in the table, labels where the masks are."""

import io
from dataclasses import replace
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
from shards.writer import begin_dataset, commit_shard, stage_motion
from tests.shards.synthetic import (
    PROVENANCE,
    dataset_record,
    synthetic_clip,
    synthetic_dataset,
    synthetic_object,
)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    return synthetic_dataset(tmp_path_factory.mktemp("data"))


@pytest.fixture
def shard(dataset) -> Shard:
    return open_dataset(dataset).shards[0]


@pytest.mark.parametrize("width", [80, 250])
def test_summary_names_every_clip_object_and_file_on_one_line(shard, width):
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(shard_summary(shard))
    lines = console.export_text().splitlines()
    assert all(len(line) <= width for line in lines)
    words = [line.split() for line in lines]
    clips, objects = shard.clips(), shard.objects()
    for name in (
        *(clip.clip_id for clip in clips),
        *(row.object_uid for row in objects),
        *shard.record.files,
    ):
        assert any(line[:1] == [name] for line in words), name
    for clip in clips:
        assert any(clip.clip_id in line and clip.camera_kind in line for line in words)
    for row in objects:
        assert any(row.object_uid in line and row.licence in line for line in words)


def test_long_ids_stay_whole_at_80_columns(tmp_path):
    """An Objaverse object, of which a user wants to copy the name."""
    uid = "objaverse/0123456789abcdef0123456789abcdef@large-mirrored"
    root = tmp_path / "long"
    begin_dataset(root, dataset_record())
    row = replace(synthetic_object(0), object_uid=uid, author="A Name That Is Quite Long")
    clip, frames = synthetic_clip(row, 0, 0, 2, 40)
    stage_motion(root, 0, 0, object_row=row, clips=[clip], frames=frames, timings_s={}, provenance=PROVENANCE)
    commit_shard(root, 0, motion_indices=[0], provenance=PROVENANCE)
    result = CliRunner().invoke(
        main, ["inspect", "shard", "0", "--out", str(root)], env={"COLUMNS": "80", "TERM": "dumb"}
    )
    assert result.exit_code == 0, result.output
    lines = [line.split() for line in result.output.splitlines()]
    assert any(line[:2] == [uid, row.licence] for line in lines)
    assert any(line[:2] == [clip.clip_id, clip.camera_kind] for line in lines)
    assert "wider terminals also show: author" in result.output


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


def test_an_unknown_clip_is_one_line_with_a_suggestion(dataset, tmp_path):
    arguments = ["inspect", "shard", "0", "--out", str(dataset), "--video", str(tmp_path / "clip.mp4")]
    result = CliRunner().invoke(main, [*arguments, "--clip", "motion-000000-cam-00"])
    assert result.exit_code == 2
    assert "no such clip" in result.output
    assert "is it 'motion-000000-camera-00'?" in result.output
    assert "Traceback" not in result.output


def test_verify_takes_one_shard_and_says_where_none_is_finished(dataset, tmp_path):
    result = CliRunner().invoke(main, ["verify", str(dataset / "shards" / "shard-00000")])
    assert result.exit_code == 0
    assert result.stdout.endswith("0 motions skipped: ok\n")
    begin_dataset(tmp_path / "empty", dataset_record())
    result = CliRunner().invoke(main, ["verify", str(tmp_path / "empty")])
    assert result.exit_code == 2
    assert "no finished shard" in result.output


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
