"""The stream over real shards: exact resume, held-out cameras, what is read, and what goes wrong."""

import os
import signal
from dataclasses import fields, replace
from itertools import islice
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from model.data.batch import Batch
from model.data.index import FRAME_COLUMNS
from model.data.order import SampleKey
from model.data.reader import SampleReader
from model.data.stream import ShardStream, StreamState, open_motions, validation_config
from model.errors import ModelError
from shards.errors import CorruptShardError, DatasetNotFoundError, ImageError, MissingColumnError, SplitError
from shards.reader import open_dataset
from shards.schema import FrameRow, ObjectRow
from shards.splits import SplitRule
from shards.storage.images import encode_rgb_png
from shards.storage.parquet import ParquetSource, file_record
from shards.storage.records import write_record
from tests.model.data.balls import stream_config, take, uid_of_split, write_balls


@pytest.fixture(scope="module")
def balls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two shards, three training motions and one for validation, three cameras; do not change it."""
    return write_balls(tmp_path_factory.mktemp("data") / "balls")


def assert_same(a: Batch, b: Batch, rows: slice = slice(None)) -> None:
    assert a.ids[rows] == b.ids
    assert a.views[rows] == b.views
    for field in fields(Batch):
        if field.name not in ("ids", "views", "surface"):
            left, right = getattr(a, field.name)[rows], getattr(b, field.name)
            torch.testing.assert_close(left, right, rtol=0, atol=0, equal_nan=True, msg=field.name)


def test_batches_have_the_promised_shapes(balls):
    for batch in take(ShardStream(stream_config(balls)), 5):
        n_views = batch.images.shape[1]
        assert 2 <= n_views <= 4
        assert batch.images.shape == (4, n_views, 3, 32, 32)
        assert batch.images.dtype == torch.float32
        assert 0.0 <= batch.images.min() <= batch.images.max() <= 1.0
        assert batch.images.max() > 0.5
        assert batch.occupancy.shape == (4, 64, 64, 64)
        assert batch.occupancy.flatten(1).any(dim=1).all()
        assert (batch.object_amodal | ~batch.object_visible).all()
        assert batch.joints_px.shape == (4, n_views, 21, 2)


def test_a_sample_is_named_with_its_clips_and_frames(balls):
    config = stream_config(balls, views=(2, 2))
    index = open_motions(config)
    (batch,) = take(ShardStream(config, index=index), 1)
    place = {motion.motion_id: number for number, motion in enumerate(index.motions)}
    for name, sample_id, views in zip(batch.names, batch.ids, batch.views, strict=True):
        motion_id, epoch, position = sample_id.split(":")
        key = SampleKey(epoch=int(epoch), position=int(position), item=place[motion_id], n_views=2)
        sample, _ = SampleReader(index, config).read(key)
        shown = [f"{clip} frame {frame}" for clip, frame in zip(sample.clip_ids, sample.frame_indices)]
        assert list(views) == shown
        assert name == f"{sample_id} ({', '.join(shown)})"
    assert batch.part(1, 3).names == batch.names[1:3] == batch.to("cpu", torch.bfloat16).names[1:3]


def test_moving_a_batch_keeps_geometry_in_float32(balls):
    (batch,) = take(ShardStream(stream_config(balls)), 1)
    moved = batch.to("cpu", torch.bfloat16)
    assert moved.images.dtype == torch.bfloat16
    assert moved.K.dtype == moved.T_cam_from_canonical.dtype == torch.float32
    assert moved.object_amodal.dtype == torch.bool
    assert moved.ids == batch.ids


def share_on_mask(points: np.ndarray, T: np.ndarray, K: np.ndarray, mask: np.ndarray) -> float:
    """Share of the points whose pixel is on the mask; those outside the image do not count."""
    cam = points @ np.float64(T[:3, :3]).T + T[:3, 3]
    x, y = np.floor((cam / cam[:, 2:]) @ np.float64(K[:2]).T).astype(int).T
    seen = (x >= 0) & (y >= 0) & (x < mask.shape[1]) & (y < mask.shape[0])
    return float(mask[y[seen], x[seen]].mean())


def test_points_project_onto_the_masks_as_well_as_before_the_crop(tmp_path):
    root = write_balls(tmp_path, splits=[["train", "train"]], cameras=2, n_frames=2, size_px=96)
    dataset = open_dataset(root)
    rows = {clip.clip_id: clip for clip in dataset.clips()}
    frames = {clip_id: dataset.read_frames(clip_id) for clip_id in rows}
    shapes = {row.object_uid: row for row in dataset.objects()}
    config = stream_config(root, image_size=96, views=(4, 4))
    reader, flips = SampleReader(open_motions(config), config), 0
    for position in range(12):
        sample, _ = reader.read(SampleKey(epoch=0, position=position, item=position % 2, n_views=4))
        flips += not sample.is_right
        shape, sign = shapes[sample.object_uid], 1 if sample.is_right else -1
        points = shape.surface_points.astype(np.float64)
        centers = (np.argwhere(sample.occupancy) + 0.5) / 64 - 0.5
        for view, (clip_id, frame) in enumerate(zip(sample.clip_ids, sample.frame_indices)):
            source = frames[clip_id]
            T = source["T_cam_from_world"][frame] @ source["T_world_from_obj"][frame]
            T = T @ shape.T_objmesh_from_canonical
            before = share_on_mask(points, T, rows[clip_id].K, source.masks(int(frame)).object_amodal)
            T_crop, K, mask = sample.T_cam_from_canonical[view], sample.K[view], sample.object_amodal[view]
            after = share_on_mask(points * [sign, 1, 1], T_crop, K, mask)
            assert after > before - 0.05
            assert share_on_mask(centers, T_crop, K, mask) > before - 0.1  # voxels stick out of the surface
            joints = source["joints_world"][frame] @ source["T_cam_from_world"][frame][:3, :3].T
            joints += source["T_cam_from_world"][frame][:3, 3]
            in_obj = np.linalg.inv(T) @ np.c_[joints, np.ones(21)].T
            in_crop = (T_crop @ (np.diag([sign, 1, 1, 1]) @ in_obj)).T[:, :3]
            joints_px = (in_crop / in_crop[:, 2:]) @ K[:2].T
            np.testing.assert_allclose(sample.joints_px[view], joints_px, atol=0.01)
    assert 0 < flips < 12


def test_same_batches_with_loader_processes(balls):
    expected = take(ShardStream(stream_config(balls)), 5)
    for batch, again in zip(expected, take(ShardStream(stream_config(balls, workers=2)), 5)):
        assert_same(batch, again)


def test_a_terminate_signal_to_the_whole_group_leaves_loaders_to_the_main_process(balls):
    """A scheduler signals all processes; the trainer saves and needs no loader to die under it."""
    stream = ShardStream(stream_config(balls, workers=1))
    batches = iter(stream)
    first = next(batches)
    loader: Any = stream._loader
    for worker in loader._iterator._workers:
        os.kill(worker.pid, signal.SIGTERM)
    more = list(islice(batches, 6))
    assert len(more) == 6
    assert first.ids != more[0].ids
    stream.close()


def test_one_two_and_one_ranks_give_the_batches_of_an_uninterrupted_run(balls):
    config = stream_config(balls)
    expected = take(ShardStream(config), 7)
    first = ShardStream(config)
    for batch, again in zip(expected[:2], take(first, 2)):
        assert_same(batch, again)
    ranks = [
        ShardStream(replace(config, workers=rank), rank=rank, world_size=2, state=first.state)
        for rank in range(2)
    ]
    parts = [take(stream, 3) for stream in ranks]
    for batch, low, high in zip(expected[2:5], *parts):
        assert_same(batch, low, slice(0, 2))
        assert_same(batch, high, slice(2, 4))
    assert ranks[0].state == ranks[1].state
    for batch, again in zip(expected[5:], take(ShardStream(config, state=ranks[0].state), 2)):
        assert_same(batch, again)


def test_state_does_not_count_what_was_only_prefetched(balls):
    stream = ShardStream(stream_config(balls, workers=1, prefetch_batches=3, batch_size=2))
    take(stream, 1)
    assert stream.state == StreamState(epoch=0, consumed=2)


def test_validation_is_the_same_every_time_and_not_varied(balls):
    training = stream_config(balls)
    config = validation_config(training, split="val", cameras="all", views=3, batch_size=2)
    stream = ShardStream(config)
    first, second = list(stream), list(stream)
    assert len(first) == len(second) == 1
    assert_same(first[0], second[0])
    assert first[0].is_right.all()
    assert len(first[0].ids) == 1


def test_held_out_cameras_are_never_trained_on(balls):
    frames = {}
    for cameras in ("train", "held_out"):
        index = open_motions(stream_config(balls, cameras=cameras, views=(1, 2)))
        frames[cameras] = {(m.shard, row) for m in index.motions for row in m.clip_rows}
        assert len(index.motions) == 3
    assert frames["train"].isdisjoint(frames["held_out"])
    assert len(frames["train"]) == 6
    assert len(frames["held_out"]) == 3
    index = open_motions(stream_config(balls, cameras="held_out", views=(1, 2)))
    clips = [index.shards[m.shard].read_clips(["camera_index"])["camera_index"] for m in index.motions]
    assert all(clip[row] == 2 for clip, m in zip(clips, index.motions) for row in m.clip_rows)


@pytest.mark.parametrize("place", ["disk", "memory"])
def test_only_the_needed_columns_and_row_groups_are_read(balls, monkeypatch, place):
    """Remote storage gets one request per clip, without geometry; on disk images are read one by one."""
    read: list[tuple[str, int, frozenset[str]]] = []
    original = ParquetSource.read_row_group

    def noted(self, group, columns=None):
        read.append((self.path, group, frozenset(columns or ("everything",))))
        return original(self, group, columns)

    where = str(balls) if place == "disk" else "memory://stream-columns"
    fsspec.filesystem("memory").put(str(balls), "/stream-columns", recursive=True)
    stream = ShardStream(stream_config(where, views=(2, 2), batch_size=1))
    monkeypatch.setattr(ParquetSource, "read_row_group", noted)
    take(stream, 1)
    fsspec.filesystem("memory").rm("/stream-columns", recursive=True)
    frames = [(path, group, columns) for path, group, columns in read if path.endswith("frames.parquet")]
    assert 1 <= len(frames) <= 2
    wanted = {"clip_id", *FRAME_COLUMNS} - ({"rgb", "masks"} if place == "disk" else set())
    assert all(columns == wanted for _, _, columns in frames)
    assert not any("everything" in columns or "mesh_glb" in columns for _, _, columns in read)


def test_a_small_cache_changes_nothing_but_speed(balls):
    expected = take(ShardStream(stream_config(balls)), 3)
    for batch, again in zip(expected, take(ShardStream(stream_config(balls, cache_mb=0)), 3)):
        assert_same(batch, again)


def test_datasets_at_a_url_and_single_shards(balls):
    memory = fsspec.filesystem("memory")
    memory.put(str(balls), "/stream-balls", recursive=True)
    try:
        (expected,) = take(ShardStream(stream_config(balls)), 1)
        (remote,) = take(ShardStream(stream_config("memory://stream-balls")), 1)
        assert_same(expected, remote)
        shards = [f"memory://stream-balls/shards/shard-{i:05d}" for i in range(2)]
        (single,) = take(ShardStream(stream_config(*shards)), 1)
        assert_same(expected, single)
    finally:
        memory.rm("/stream-balls", recursive=True)


def assert_one_line(error: BaseException, *parts: str) -> None:
    assert "\n" not in str(error)
    assert all(part in str(error) for part in parts), str(error)


def test_no_finished_shard(tmp_path):
    write_balls(tmp_path, splits=())
    with pytest.raises(DatasetNotFoundError) as caught:
        open_motions(stream_config(tmp_path))
    assert_one_line(caught.value, str(tmp_path), "no finished shard")


def test_no_motion_of_the_split(balls):
    with pytest.raises(ModelError) as caught:
        open_motions(stream_config(balls, split="test"))
    assert_one_line(caught.value, "3 train, 1 val, 0 test", "'test'")


def test_an_object_in_two_splits_is_refused(balls, tmp_path):
    everything_val = SplitRule(val_fraction=1.0, test_fraction=0.0)
    uid = uid_of_split("train", 0)
    number = int(uid.removeprefix("ball-"))
    other = write_balls(tmp_path, splits=[["val"] * (number + 1)], cameras=1, rule=everything_val)
    with pytest.raises(SplitError) as caught:
        open_motions(stream_config(balls, other))
    assert_one_line(caught.value, f"'{uid}'", "shard-00000", "one split")


def test_an_at_sign_in_a_folder_name_makes_no_variant(tmp_path):
    """Different objects of a folder `batch@1` may be in different splits."""

    def named(row: ObjectRow) -> ObjectRow:
        return replace(row, object_uid=f"batch@1/{row.object_uid}")

    index = open_motions(stream_config(write_balls(tmp_path, change_object=named)))
    assert {motion.object_uid.partition("/")[0] for motion in index.motions} == {"batch@1"}
    assert len(index.motions) == 3


def test_more_views_than_frames(balls):
    with pytest.raises(ModelError) as caught:
        open_motions(stream_config(balls, views=(2, 10)))
    assert_one_line(caught.value, "motion-000000", "9 frames", "10 views")


def test_a_batch_that_the_ranks_cannot_share(balls):
    with pytest.raises(ModelError, match="4 samples cannot be shared by 3 ranks"):
        ShardStream(stream_config(balls), rank=0, world_size=3)


@pytest.mark.parametrize(
    ("section", "name", "value"),
    [("stream", "views", (3, 2)), ("stream", "batch_size", 0), ("data", "datasets", ())],
)
def test_bad_configuration(section, name, value):
    with pytest.raises(ModelError, match=rf"{section}\.{name}"):
        stream_config("x", **{name: value})


def test_missing_column(tmp_path):
    root = write_balls(tmp_path, splits=[["train"]])
    folder = root / "shards" / "shard-00000"
    table = pq.read_table(folder / "frames.parquet").drop_columns(["masks"])
    pq.write_table(table, folder / "frames.parquet")
    record = open_dataset(root).shards[0].record
    files = record.files | {"frames.parquet": file_record(folder / "frames.parquet")}
    write_record(folder / "shard.json", replace(record, files=files))
    with pytest.raises(MissingColumnError) as caught:
        open_motions(stream_config(root))
    assert_one_line(caught.value, "shard-00000", "'masks'")


def corrupt_last_frame_of_first_clip(frame: FrameRow) -> FrameRow:
    if frame.clip_id == "motion-000000-camera-00" and frame.frame_index == 2:
        return replace(frame, rgb=encode_rgb_png(np.zeros((40, 40, 3), np.uint8))[:-20])
    return frame


@pytest.fixture(scope="module")
def corrupt_row(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One motion of which one frame of six does not decode."""
    root = tmp_path_factory.mktemp("corrupt") / "row"
    return write_balls(
        root, splits=[["train", "train"]], cameras=2, change_frame=corrupt_last_frame_of_first_clip
    )


@pytest.mark.parametrize("workers", [0, 1])
def test_a_corrupt_row_is_named(corrupt_row, workers):
    stream = ShardStream(stream_config(corrupt_row, workers=workers))
    with pytest.raises(ImageError) as caught:
        take(stream, 20)
    assert_one_line(caught.value, "shard-00000/frames.parquet", "motion-000000-camera-00", "frame 2", "'rgb'")


def test_a_corrupt_row_is_skipped_and_counted_once(corrupt_row):
    config = stream_config(corrupt_row, max_corrupt=1)
    stream = ShardStream(config)
    batches = take(stream, 12)
    assert len(stream.corrupt_rows) == 1
    assert "frame 2" in next(iter(stream.corrupt_rows))
    assert all(len(batch.ids) == 4 for batch in batches)
    assert [batch.ids for batch in batches] == [batch.ids for batch in take(ShardStream(config), 12)]


def test_too_many_corrupt_rows_stop_the_stream(tmp_path):
    def corrupt_last_frames(frame: FrameRow) -> FrameRow:
        return replace(frame, rgb=frame.rgb[:-20]) if frame.frame_index == 2 else frame

    root = write_balls(tmp_path, splits=[["train", "train"]], cameras=2, change_frame=corrupt_last_frames)
    with pytest.raises(CorruptShardError) as caught:
        take(ShardStream(stream_config(root, max_corrupt=1)), 20)
    assert_one_line(caught.value, "2 corrupt rows", "at most 1", "frame 2")


@pytest.mark.parametrize(("column", "workers"), [("rgb", 0), ("rgb", 1), ("joints_px", 0)])
def test_flipped_bits_in_a_file(tmp_path, column, workers):
    root = write_balls(tmp_path, splits=[["train"]], cameras=1, n_frames=4)
    path = root / "shards" / "shard-00000" / "frames.parquet"
    group = pq.read_metadata(path).row_group(0)
    chunks = [group.column(i) for i in range(group.num_columns)]
    (chunk,) = [chunk for chunk in chunks if chunk.path_in_schema.split(".")[0] == column]
    data = bytearray(path.read_bytes())
    data[chunk.data_page_offset + chunk.total_compressed_size // 2] ^= 4
    path.write_bytes(data)
    config = stream_config(root, workers=workers, views=(4, 4), batch_size=1)
    with pytest.raises(CorruptShardError) as caught:
        take(ShardStream(config), 1)
    assert_one_line(caught.value, "frames.parquet", "group 0", f"'{column}'")
    # all four frames are needed, and nothing else is left to take their place
    with pytest.raises(CorruptShardError, match="no readable sample"):
        take(ShardStream(replace(config, max_corrupt=5)), 1)
