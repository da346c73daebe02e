"""Opening and reading: what was written, from anywhere, and no more bytes than asked for."""

import dataclasses
import pickle
import shutil
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
from fsspec.implementations.local import LocalFileSystem

from shards.columns import columns_of
from shards.errors import DatasetNotFoundError, IncompleteShardError, MissingColumnError, SchemaVersionError
from shards.reader import find_clip, open_dataset, open_shard, open_shards
from shards.schema import SCHEMA_VERSION, FrameRow
from shards.storage.images import decode_masks
from shards.storage.records import check_schema_version, write_record
from shards.writer import begin_dataset
from tests.shards.synthetic import PROVENANCE, stage_synthetic, synthetic_clip, synthetic_object


def test_clips_objects_and_frames_are_those_written(dataset_dir):
    dataset = open_dataset(dataset_dir)
    assert [row.object_uid for row in dataset.objects()] == ["ball-0", "ball-1"]
    clips = list(dataset.clips())
    assert [clip.clip_id for clip in clips] == [
        f"motion-00000{m}-camera-0{c}" for m in (0, 1) for c in (0, 1)
    ]
    _, written = synthetic_clip(synthetic_object(1), 1, 1, 3, 40)
    frames = dataset.read_frames("motion-000001-camera-01")
    for c in columns_of(FrameRow):
        expected: Any = [getattr(row, c.name) for row in written]
        if c.dtype not in ("string", "binary"):
            expected = np.array(expected).astype(c.dtype)
        np.testing.assert_array_equal(frames[c.name], expected, err_msg=c.name)
    frame = frames.frame(2)
    assert frame.row.frame_index == 2
    assert frame.rgb.shape == (40, 40, 3)
    np.testing.assert_array_equal(frame.masks.hand_visible, decode_masks(written[2].masks).hand_visible)
    np.testing.assert_array_equal(frame.geometry.depth_object > 0, frame.masks.object_amodal)


def test_only_the_columns_asked_for_are_there(dataset_dir):
    frames = open_dataset(dataset_dir).read_frames("motion-000000-camera-00", ["T_cam_from_world", "masks"])
    assert frames["T_cam_from_world"].shape == (3, 4, 4)
    assert frames.masks(0).hand_amodal.dtype == bool
    with pytest.raises(MissingColumnError, match=r"'rgb': this column was not read.*add 'rgb'"):
        frames.rgb(0)
    with pytest.raises(MissingColumnError, match=r"this column was not read"):
        frames.frame(0)
    with pytest.raises(MissingColumnError, match=r"no such column"):
        frames["depth"]
    with pytest.raises(MissingColumnError, match=r"'depht'"):
        open_dataset(dataset_dir).read_frames("motion-000000-camera-00", ["depht"])


class CountingFileSystem(LocalFileSystem):
    """The local disk, counting what is read."""

    protocol = "counting"
    cachable = False

    def __init__(self) -> None:
        super().__init__()
        self.n_bytes = 0

    def cat_file(self, path, start=None, end=None, **kwargs):
        data = super().cat_file(path, start=start, end=end, **kwargs)
        self.n_bytes += len(data)
        return data


def test_a_projection_fetches_only_its_own_bytes(dataset_dir):
    plain = open_dataset(dataset_dir).shards[0]
    fs = CountingFileSystem()
    shard = dataclasses.replace(plain, fs=fs)
    source = shard.source("frames")
    assert source.num_row_groups == 4  # fetches the footer
    assert fs.n_bytes == plain.record.files["frames.parquet"].footer_bytes
    sizes = {
        source.metadata.row_group(0).column(i).path_in_schema: source.metadata.row_group(0).column(i)
        for i in range(source.metadata.num_columns)
    }
    fs.n_bytes = 0
    shard.read_frames("motion-000000-camera-00", ["masks"])
    assert fs.n_bytes == sum(sizes[name].total_compressed_size for name in ("clip_id", "masks"))
    fs.n_bytes = 0
    shard.read_frames("motion-000000-camera-00")
    assert fs.n_bytes == sum(chunk.total_compressed_size for chunk in sizes.values())


def test_any_fsspec_location_reads_the_same(dataset_dir):
    memory = fsspec.filesystem("memory")
    memory.put(str(dataset_dir), "/remote/two-balls", recursive=True)
    try:
        remote, local = open_dataset("memory://remote/two-balls"), open_dataset(dataset_dir)
        assert [clip.clip_id for clip in remote.clips()] == [clip.clip_id for clip in local.clips()]
        for clip_id in remote.shards[0].record.clip_ids:
            assert remote.read_frames(clip_id).arrow.equals(local.read_frames(clip_id).arrow)
        assert open_dataset("memory://remote/two-balls", shards=[0]).shards[0].record.shard == 0
        memory.rm("/remote/two-balls/shards/shard-00000/frames.parquet")
        with pytest.raises(IncompleteShardError, match=r"the file is missing"):
            open_dataset("memory://remote/two-balls").read_frames("motion-000000-camera-00")
    finally:
        memory.rm("/remote", recursive=True)


def test_a_dataset_can_be_sent_to_another_process(dataset_dir):
    dataset = open_dataset(dataset_dir)
    dataset.read_frames("motion-000000-camera-00", ["rgb"])  # caches are filled
    copy = pickle.loads(pickle.dumps(dataset))
    np.testing.assert_array_equal(
        copy.read_frames("motion-000000-camera-00").rgb(1),
        dataset.read_frames("motion-000000-camera-00").rgb(1),
    )


def test_unfinished_shards_do_not_exist(dataset_copy):
    stage_synthetic(dataset_copy, 7)
    (dataset_copy / "shards/shard-00001").mkdir()
    (dataset_copy / "shards/shard-00001/frames.parquet").write_bytes(b"PAR1")
    assert [shard.record.shard for shard in open_dataset(dataset_copy).shards] == [0]
    with pytest.raises(DatasetNotFoundError, match=r"shard-00001/shard.json.*unfinished"):
        open_shard(dataset_copy / "shards/shard-00001")


def test_what_is_not_there_is_said_plainly(dataset_dir, tmp_path):
    with pytest.raises(DatasetNotFoundError, match=r"nowhere/dataset.json: no such file"):
        open_dataset(tmp_path / "nowhere")
    dataset = open_dataset(dataset_dir)
    for place in (dataset, dataset.shards[0]):
        with pytest.raises(DatasetNotFoundError, match=r"no such clip.*one of its 4 clips, found x"):
            place.read_frames("x")
    with pytest.raises(DatasetNotFoundError, match=r"is it 'motion-000001-camera-00'\?"):
        dataset.shards[0].read_clip("motion-00001-camera-00")
    with pytest.raises(DatasetNotFoundError, match=r"objects.parquet: no such object \(found ball-7\)"):
        dataset.shards[0].read_object("ball-7", ["name"])


def test_an_address_is_a_dataset_or_one_shard(dataset_dir, tmp_path):
    folder = dataset_dir / "shards" / "shard-00000"
    elsewhere = tmp_path / "my shard"  # a name says nothing
    shutil.copytree(folder, elsewhere)
    for url in (dataset_dir, f"{dataset_dir}/", folder, f"{folder}/", elsewhere):
        (shard,) = open_shards(url)
        assert shard.record == open_shard(folder).record
    assert open_shard(folder).read_split_rule() == open_dataset(dataset_dir).record.split_rule
    assert open_shard(elsewhere).read_split_rule() is None
    begin_dataset(tmp_path / "empty", open_dataset(dataset_dir).record)
    with pytest.raises(DatasetNotFoundError, match=r"empty: no finished shard .*make render SHARD=0"):
        open_shards(tmp_path / "empty")
    with pytest.raises(DatasetNotFoundError, match="no such file"):
        open_shards(tmp_path / "nowhere")


def test_rows_are_found_by_name(dataset_dir):
    (shard,) = open_shards(dataset_dir)
    for row in shard.objects():
        table = shard.read_object(
            row.object_uid, ["object_uid", "surface_points", "object_scale_m", "mesh_glb"]
        )
        assert len(table) == 1
        assert table["object_uid"] == [row.object_uid]
        assert table["mesh_glb"] == [row.mesh_glb]
        np.testing.assert_array_equal(table["surface_points"][0], row.surface_points)
        assert table["object_scale_m"].tolist() == [row.object_scale_m]
        assert shard.has_object(row.object_uid)
    assert not shard.has_object("ball")
    for clip in shard.clips():
        assert shard.read_clip(clip.clip_id).camera_index == clip.camera_index
        assert find_clip([shard], clip.clip_id, where="here") is shard


def test_of_an_object_only_the_named_columns_are_fetched(dataset_dir):
    (plain,) = open_shards(dataset_dir)
    fs = CountingFileSystem()
    shard = dataclasses.replace(plain, fs=fs)
    assert shard.has_object("ball-1")
    source, fs.n_bytes = shard.source("objects"), 0
    shard.read_object("ball-1", ["T_objmesh_from_canonical"])
    group = source.metadata.row_group(1)
    (chunk,) = (
        chunk
        for chunk in map(group.column, range(group.num_columns))
        if chunk.path_in_schema.startswith("T_objmesh_from_canonical")
    )
    assert fs.n_bytes == chunk.total_compressed_size


@pytest.mark.parametrize(
    ("version", "message"),
    [
        ("1.1.0", "newer schema .expected 1.0.0, found 1.1.0.; update the shards package"),
        ("2.0.0", "newer schema"),
        ("0.9.3", "older schema"),
    ],
)
def test_other_schema_versions_are_refused_with_advice(dataset_copy, version, message):
    path = dataset_copy / "dataset.json"
    write_record(path, dataclasses.replace(open_dataset(dataset_copy).record, schema_version=version))
    with pytest.raises(SchemaVersionError, match=message):
        open_dataset(dataset_copy)


def test_patch_versions_are_read():
    major, minor, _ = SCHEMA_VERSION.split(".")
    check_schema_version(f"{major}.{minor}.999", where="x")


def test_provenance_reaches_the_reader(dataset_dir):
    dataset = open_dataset(Path(dataset_dir))
    assert dataset.record.provenance == PROVENANCE
    assert dataset.shards[0].record.motions[0].timings_s == {"render": 1.5}
