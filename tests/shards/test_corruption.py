"""Damaged bytes raise a ShardError: never wrong data, never another kind of error."""

import random
from pathlib import Path

import pytest

from shards.columns import columns_of
from shards.errors import CorruptShardError, ShardError, TruncatedError
from shards.reader import open_dataset, open_shard
from shards.schema import ClipRow, FrameRow, ObjectRow
from shards.verify import verify_dataset

SHARD_FILES = ("shard.json", "objects.parquet", "clips.parquet", "frames.parquet")
FILES = ["dataset.json", *(f"shards/shard-00000/{name}" for name in SHARD_FILES)]


def read_everything(root: Path) -> list:
    """Every number and byte a user can get, in a form that compares."""
    dataset = open_dataset(root)
    content: list = [dataset.record, *(shard.record for shard in dataset.shards)]
    for row in (*dataset.clips(), *dataset.objects()):
        content += [comparable(getattr(row, c.name)) for c in columns_of(type(row))]
    for shard in dataset.shards:
        for clip_id in shard.record.clip_ids:
            frames = shard.read_frames(clip_id)
            content += [comparable(frames[c.name]) for c in columns_of(FrameRow)]
    return content


def comparable(value: object) -> object:
    return value.tobytes() if hasattr(value, "tobytes") else repr(value)


def verified(root: Path) -> bool:
    """Whether `datagen verify` would call it good."""
    try:
        return all(report.ok for report in verify_dataset(root))
    except ShardError:
        return False


@pytest.mark.parametrize("name", FILES)
def test_flipped_bits_never_give_wrong_data(dataset_dir, dataset_copy, name):
    truth = read_everything(dataset_dir)
    path = dataset_copy / name
    good, rng, raised = path.read_bytes(), random.Random(name), 0
    for _ in range(25):
        data, position = bytearray(good), rng.randrange(len(good))
        data[position] ^= 1 << rng.randrange(8)
        path.write_bytes(data)
        try:
            assert read_everything(dataset_copy) == truth, f"silently wrong: byte {position}"
        except ShardError:
            raised += 1
        if name.endswith(".parquet"):  # in JSON, a changed blank between tokens changes nothing
            assert not verified(dataset_copy)
    assert raised > 5


@pytest.mark.parametrize("name", FILES)
def test_truncated_files_are_noticed(dataset_copy, name):
    path = dataset_copy / name
    good, rng = path.read_bytes(), random.Random(name)
    for length in (0, 1, len(good) // 2, len(good) - 2, rng.randrange(len(good))):
        path.write_bytes(good[:length])
        with pytest.raises(CorruptShardError) as caught:
            read_everything(dataset_copy)
        assert path.name in str(caught.value)
        assert "\n" not in str(caught.value)
        assert not verified(dataset_copy)
    if name.endswith(".parquet"):
        path.write_bytes(good + b"tail")
        with pytest.raises(TruncatedError, match=r"wrong size"):
            read_everything(dataset_copy)


def test_files_of_another_shard_are_noticed(dataset_copy):
    folder = dataset_copy / "shards/shard-00000"
    (folder / "clips.parquet").write_bytes((folder / "objects.parquet").read_bytes())
    with pytest.raises(CorruptShardError):
        open_shard(folder).clips()


@pytest.mark.slow
@pytest.mark.parametrize("row_type", [ObjectRow, ClipRow])
def test_every_bit_of_every_page_header(dataset_copy, row_type):
    """Parquet has no checksum for page headers: some flips there read as other numbers."""
    name = {ObjectRow: "objects", ClipRow: "clips"}[row_type]
    shard = open_shard(dataset_copy / "shards/shard-00000")
    group = shard.source(name).metadata.row_group(0)
    read = {ObjectRow: shard.read_objects, ClipRow: shard.read_clips}[row_type]
    path = dataset_copy / f"shards/shard-00000/{name}.parquet"
    with path.open("r+b", buffering=0) as file:
        for i in range(group.num_columns):
            chunk = group.column(i)
            file.seek(chunk.data_page_offset)
            header = file.read(min(40, chunk.total_compressed_size))
            for bit in range(8 * len(header)):
                damaged = bytearray(header)
                damaged[bit // 8] ^= 1 << bit % 8
                file.seek(chunk.data_page_offset)
                file.write(damaged)
                with pytest.raises(CorruptShardError):
                    read([chunk.path_in_schema.split(".")[0]])
            file.seek(chunk.data_page_offset)
            file.write(header)
