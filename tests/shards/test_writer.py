"""Staging and commit: what is accepted, what is refused, what comes out."""

import dataclasses
import tracemalloc

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from shards.errors import ChecksumError, IncompleteShardError, RowError, ShardError
from shards.reader import open_dataset, open_shard
from shards.writer import (
    begin_dataset,
    commit_shard,
    is_motion_staged,
    is_shard_committed,
    motion_dir,
    shard_dir,
    stage_motion,
    stage_skipped_motion,
)
from tests.shards.crash_child import tree_hashes
from tests.shards.synthetic import (
    PROVENANCE,
    dataset_record,
    stage_synthetic,
    synthetic_clip,
    synthetic_dataset,
    synthetic_object,
)


def commit(root, *motion_indices):
    return commit_shard(root, 0, motion_indices=motion_indices, provenance=PROVENANCE)


def stage(root, motion_index=0, *, change_clip=None, change_frames=None, object_row=None):
    """A motion of one clip and three frames, with something changed."""
    object_row = object_row or synthetic_object(0)
    clip, frames = synthetic_clip(object_row, motion_index, 0, 3, 24)
    clip = dataclasses.replace(clip, **(change_clip or {}))
    frames = change_frames(frames) if change_frames else frames
    return stage_motion(
        root,
        0,
        motion_index,
        object_row=object_row,
        clips=[clip],
        frames=iter(frames),
        timings_s={},
        provenance=PROVENANCE,
    )


def test_same_input_gives_the_same_bytes(dataset_dir, tmp_path):
    assert tree_hashes(synthetic_dataset(tmp_path / "again")) == tree_hashes(dataset_dir)


def test_the_order_of_staging_does_not_matter(dataset_dir, tmp_path):
    begin_dataset(tmp_path, dataset_record())
    for motion_index in (1, 0):
        stage_synthetic(tmp_path, motion_index)
    commit(tmp_path, 0, 1)
    assert tree_hashes(tmp_path) == tree_hashes(dataset_dir)


def test_committing_again_changes_nothing(dataset_copy):
    before = tree_hashes(dataset_copy)
    stage_synthetic(dataset_copy, 0)  # a straggler that finished after the commit
    record = commit(dataset_copy, 0, 1)
    assert tree_hashes(dataset_copy) == before
    assert record == open_dataset(dataset_copy).shards[0].record


def test_files_are_laid_out_as_the_readme_says(dataset_dir):
    folder = shard_dir(dataset_dir, 0)
    assert sorted(path.name for path in folder.iterdir()) == [
        "clips.parquet",
        "frames.parquet",
        "objects.parquet",
        "shard.json",
    ]
    metadata = pq.read_metadata(folder / "frames.parquet")
    assert metadata.num_row_groups == 4
    assert metadata.metadata[b"schema_version"] == b"1.0.0"
    assert metadata.metadata[b"config_sha256"].decode() == PROVENANCE.config_sha256
    for group in range(metadata.num_row_groups):
        for i in range(metadata.num_columns):
            chunk = metadata.row_group(group).column(i)
            blob = chunk.path_in_schema in ("rgb", "masks", "geometry")
            assert chunk.compression == ("UNCOMPRESSED" if blob else "ZSTD")
            assert not chunk.has_dictionary_page
            assert chunk.has_offset_index
    table = pq.read_table(folder / "frames.parquet", page_checksum_verification=True)
    assert table["frame_index"].to_pylist() == [0, 1, 2] * 4


def test_skipped_motions_are_listed_with_their_reason(tmp_path):
    stage(tmp_path, 0)
    reason = "no grasp in 20 attempts"
    stage_skipped_motion(tmp_path, 0, 1, reason=reason, timings_s={}, provenance=PROVENANCE)
    assert is_motion_staged(tmp_path, 0, 1, PROVENANCE)
    record = commit(tmp_path, 0, 1)
    assert [(m.motion_index, m.skip_reason) for m in record.skipped] == [(1, reason)]
    assert record.clip_ids == ("motion-000000-camera-00",)


def test_a_shard_of_skipped_motions_is_empty_and_readable(tmp_path):
    begin_dataset(tmp_path, dataset_record())
    stage_skipped_motion(tmp_path, 0, 0, reason="broken mesh", timings_s={}, provenance=PROVENANCE)
    commit(tmp_path, 0)
    dataset = open_dataset(tmp_path)
    assert list(dataset.clips()) == list(dataset.objects()) == []


def test_an_object_shared_by_motions_is_stored_once(tmp_path):
    for motion_index in range(3):
        stage(tmp_path, motion_index)
    commit(tmp_path, 0, 1, 2)
    shard = open_shard(shard_dir(tmp_path, 0))
    assert shard.read_objects(["object_uid"])["object_uid"] == ["ball-0"]
    assert len(shard.clips()) == 3


def test_two_versions_of_one_object_are_refused(tmp_path):
    stage(tmp_path, 0)
    stage(tmp_path, 1, object_row=dataclasses.replace(synthetic_object(0), author="someone"))
    with pytest.raises(RowError, match=r"same object differently.*ball-0"):
        commit(tmp_path, 0, 1)
    assert is_motion_staged(tmp_path, 0, 0, PROVENANCE)


def test_a_shard_with_unfinished_motions_is_not_committed(tmp_path):
    stage(tmp_path, 0)
    with pytest.raises(IncompleteShardError, match=r"2 of 3 motions are not finished.*motion 1, 2"):
        commit(tmp_path, 0, 1, 2)
    assert not is_shard_committed(tmp_path, 0)


def test_clip_ids_must_be_unique(tmp_path):
    stage(tmp_path, 0)
    other = {"clip_id": "motion-000000-camera-00"}
    rename = lambda frames: [dataclasses.replace(f, **other) for f in frames]  # noqa: E731
    stage(tmp_path, 1, change_clip=other, change_frames=rename)
    with pytest.raises(RowError, match=r"not unique"):
        commit(tmp_path, 0, 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"change_clip": {"motion_index": 5}}, "motion_index.*expected 0, found 5"),
        ({"change_clip": {"object_uid": "other"}}, "object_uid.*expected ball-0"),
        ({"change_clip": {"n_frames": 4}}, "expected 4 frames"),
        ({"change_frames": lambda frames: frames[::-1]}, "not 0..n_frames-1"),
        ({"change_frames": lambda frames: []}, "out of order"),
        (
            {"change_frames": lambda frames: [*frames, dataclasses.replace(frames[0], clip_id="x")]},
            "unknown clip.*found x",
        ),
        ({"change_clip": {"slip_lift_m": np.inf}}, "slip_lift_m.*not a finite"),
    ],
)
def test_inconsistent_motions_are_refused_and_leave_nothing(tmp_path, change, message):
    with pytest.raises(RowError, match=message):
        stage(tmp_path, 0, **change)
    assert not motion_dir(tmp_path, 0, 0).exists()


def test_a_damaged_fragment_is_found_before_the_shard_exists(tmp_path):
    stage(tmp_path, 0)
    fragment = motion_dir(tmp_path, 0, 0) / "frames.parquet"
    data = bytearray(fragment.read_bytes())
    data[500] ^= 1
    fragment.write_bytes(data)
    with pytest.raises(ChecksumError, match=r"motion-000000/frames.parquet"):
        commit(tmp_path, 0)
    assert not is_shard_committed(tmp_path, 0)


def test_motions_of_another_configuration_are_not_mixed(tmp_path):
    stage(tmp_path, 0)
    begin_dataset(tmp_path, dataset_record())
    other = dataclasses.replace(PROVENANCE, config_sha256="f" * 64)
    with pytest.raises(ShardError, match=r"another configuration.*delete"):
        is_motion_staged(tmp_path, 0, 0, other)
    with pytest.raises(ShardError, match=r"another configuration.*choose another output folder"):
        begin_dataset(tmp_path, dataclasses.replace(dataset_record(), provenance=other))
    begin_dataset(tmp_path, dataset_record())


def test_what_an_interrupted_run_left_is_cleared_away(tmp_path):
    for folder in (
        motion_dir(tmp_path, 0, 0),
        shard_dir(tmp_path, 0),
        tmp_path / "shards/.shard-00000.partial",
    ):
        folder.mkdir(parents=True)
        (folder / "frames.parquet").write_bytes(b"half a file")
    assert not is_motion_staged(tmp_path, 0, 0, PROVENANCE)
    stage(tmp_path, 0)
    commit(tmp_path, 0)
    assert [path.name for path in (tmp_path / "shards").iterdir()] == ["shard-00000"]
    assert list((tmp_path / "staging").iterdir()) == []


def test_committing_holds_one_clip_in_memory(tmp_path):
    object_row = synthetic_object(0)
    for motion_index in range(12):
        clip, frames = synthetic_clip(object_row, motion_index, 0, 3, 24)
        stage_motion(
            tmp_path,
            0,
            motion_index,
            object_row=object_row,
            clips=[clip],
            frames=[dataclasses.replace(frame, rgb=bytes(400_000)) for frame in frames],
            timings_s={},
            provenance=PROVENANCE,
        )
    tracemalloc.start()
    pool = pa.proxy_memory_pool(pa.default_memory_pool())
    before = pa.default_memory_pool()
    pa.set_memory_pool(pool)
    try:
        commit(tmp_path, *range(12))
        peak = tracemalloc.get_traced_memory()[1] + (pool.max_memory() or 0)
    finally:
        pa.set_memory_pool(before)
        tracemalloc.stop()
    assert peak < 8 * 1_200_000  # of 14.4 MB in all
