"""Single images read from a file on disk: the same bytes as whole chunks, and no damage unnoticed."""

from dataclasses import replace
from pathlib import Path

import fsspec
import numpy as np
import pytest

from shards.errors import CorruptShardError
from shards.reader import open_dataset
from shards.storage.frame_pages import local_pages
from shards.storage.images import encode_rgb_png
from shards.storage.parquet import ParquetSource
from shards.writer import begin_dataset, commit_shard
from tests.shards.synthetic import PROVENANCE, dataset_record, stage_synthetic

COLUMNS = ("rgb", "masks")


def noisy(frame):
    """An image too large to share a page with the next one."""
    rng = np.random.default_rng(frame.frame_index)
    return replace(frame, rgb=encode_rgb_png(rng.integers(0, 256, (160, 160, 3), dtype=np.uint8)))


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> ParquetSource:
    root = tmp_path_factory.mktemp("pages") / "data"
    begin_dataset(root, dataset_record())
    stage_synthetic(root, 0, change_frame=noisy)
    commit_shard(root, 0, motion_indices=[0], provenance=PROVENANCE)
    return open_dataset(root).shards[0].source("frames")


def all_blobs(source: ParquetSource) -> dict[tuple[int, str, int], bytes]:
    pages = local_pages(source, COLUMNS)
    assert pages is not None
    return {
        (group, column, row): bytes(pages.blob(group, column, row))
        for group in range(2)
        for column in COLUMNS
        for row in range(3)
    }


def test_the_same_bytes_as_from_whole_chunks(source):
    for (group, column, row), blob in all_blobs(source).items():
        assert blob == source.read_row_group(group, [column])[column][row].as_py()


def test_rows_that_do_not_exist(source):
    pages = local_pages(source, COLUMNS)
    with pytest.raises(CorruptShardError, match="no such row"):
        pages.blob(0, "rgb", 3)


def test_every_flipped_bit_is_noticed_or_changes_nothing(source, tmp_path):
    """Headers have no checksum of their own in Parquet."""
    right, whole = all_blobs(source), Path(source.path).read_bytes()
    chunks = [
        source.metadata.row_group(0).column(source.metadata.schema.names.index(name)) for name in COLUMNS
    ]
    starts = [chunk.data_page_offset for chunk in chunks]
    pages = local_pages(source, COLUMNS)
    headers = [range(start, start + 40) for start in starts]
    tables = [pages._page_table(0, name) for name in COLUMNS]
    headers += [range(page.start - 30, page.start + 8) for table in tables for page in table]
    path, harmless, noticed = tmp_path / "frames.parquet", 0, 0
    for position in sorted({place for header in headers for place in header}):
        for bit in range(8):
            damaged = bytearray(whole)
            damaged[position] ^= 1 << bit
            path.write_bytes(damaged)
            try:
                assert all_blobs(replace(source, path=str(path))) == right
                harmless += 1
            except CorruptShardError:
                noticed += 1
    assert noticed > harmless


def test_remote_and_unusual_files_are_read_as_chunks(source):
    assert local_pages(source, (*COLUMNS, "time_s")) is None  # compressed
    assert local_pages(source, (*COLUMNS, "joints_px")) is None  # nested
    assert local_pages(replace(source, fs=fsspec.filesystem("memory")), COLUMNS) is None
