"""A disk that is really full: one clear line, and nothing finished is lost."""

import resource
import shutil
import subprocess
from contextlib import contextmanager
from pathlib import Path

import pytest

from shards.errors import DiskFullError, StorageError
from shards.reader import open_dataset
from shards.writer import begin_dataset, commit_shard, is_motion_staged, is_shard_committed
from tests.shards.synthetic import PROVENANCE, dataset_record, stage_synthetic


@pytest.fixture
def small_disk(tmp_path):
    """A file system of its own with 1.5 MB."""
    mount_point = tmp_path / "disk"
    mount_point.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=1536k", "tmpfs", str(mount_point)]
    if shutil.which("mount") is None or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("no right to mount a tmpfs")
    yield mount_point
    subprocess.run(["umount", "-l", str(mount_point)], check=True)


@contextmanager
def largest_file(n_bytes: int):
    """No file of this process may grow beyond `n_bytes` (as a disk quota would have it)."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def fill(folder: Path, leave_bytes: int) -> Path:
    """Fill the disk up to `leave_bytes`."""
    ballast = folder / "ballast"
    ballast.write_bytes(bytes(shutil.disk_usage(folder).free - leave_bytes))
    return ballast


def test_a_full_disk_while_staging_keeps_the_motions_before(small_disk):
    stage_synthetic(small_disk, 0)
    ballast = fill(small_disk, leave_bytes=60_000)
    with pytest.raises(DiskFullError) as caught:
        stage_synthetic(small_disk, 1)
    assert one_clear_line(caught.value, "storing motion 1 failed: no space left", "motion-000001")
    assert is_motion_staged(small_disk, 0, 0, PROVENANCE)
    assert not is_motion_staged(small_disk, 0, 1, PROVENANCE)
    assert not (small_disk / "staging/shard-00000/motion-000001").exists()
    ballast.unlink()
    stage_synthetic(small_disk, 1)
    commit_shard(small_disk, 0, motion_indices=[0, 1], provenance=PROVENANCE)


def test_a_full_disk_while_committing_keeps_all_motions(small_disk):
    begin_dataset(small_disk, dataset_record())
    for motion_index in range(2):
        stage_synthetic(small_disk, motion_index)
    ballast = fill(small_disk, leave_bytes=100_000)
    with pytest.raises(DiskFullError) as caught:
        commit_shard(small_disk, 0, motion_indices=[0, 1], provenance=PROVENANCE)
    assert one_clear_line(caught.value, "committing shard 0 failed: no space left", "MB needed", "MB free")
    assert not is_shard_committed(small_disk, 0)
    assert open_dataset(small_disk).shards == ()
    ballast.unlink()
    commit_shard(small_disk, 0, motion_indices=[0, 1], provenance=PROVENANCE)
    assert len(list(open_dataset(small_disk).clips())) == 4


@pytest.mark.parametrize("limit_bytes", [0, 4, 5_000, 20_000, 50_000])
def test_a_file_size_limit_is_reported_and_loses_nothing(tmp_path, limit_bytes):
    stage_synthetic(tmp_path, 0)
    with largest_file(limit_bytes), pytest.raises(DiskFullError) as caught:
        stage_synthetic(tmp_path, 1)
    assert one_clear_line(caught.value, "file-size limit or quota reached")
    with largest_file(limit_bytes), pytest.raises(DiskFullError):
        commit_shard(tmp_path, 0, motion_indices=[0], provenance=PROVENANCE)
    commit_shard(tmp_path, 0, motion_indices=[0], provenance=PROVENANCE)


def test_a_folder_that_cannot_be_made_is_reported(tmp_path):
    (tmp_path / "staging").write_text("a file where a folder must be")
    with pytest.raises(StorageError, match=r"staging") as caught:
        stage_synthetic(tmp_path, 0)
    assert one_clear_line(caught.value)


def one_clear_line(error: Exception, *parts: str) -> bool:
    text = str(error)
    assert "\n" not in text
    assert len(text) < 400, text
    for part in parts:
        assert part in text, text
    return True
