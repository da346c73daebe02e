"""Killed anywhere, a shard is complete and verified or absent, and finished motions are kept."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.shards.crash_child import logged, staged_motions, tree_hashes

ROOT = Path(__file__).parents[2]
MAKE_SHARD = """
import sys
from pathlib import Path
from tests.shards.crash_child import make_shard
print("ready", flush=True)
make_shard(Path(sys.argv[1]))
"""


def kill_before_every_file_system_call(folder: Path, step: int) -> dict:
    command = [sys.executable, "-m", "tests.shards.crash_child", str(folder), str(step)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_killed_before_every_ninth_file_system_call(tmp_path):
    report = kill_before_every_file_system_call(tmp_path, step=9)
    assert report["failures"] == {}
    assert report["kill_points"] > 8


@pytest.mark.slow
def test_killed_before_every_file_system_call(tmp_path):
    report = kill_before_every_file_system_call(tmp_path, step=1)
    assert report["failures"] == {}
    assert report["kill_points"] > 80


@pytest.mark.slow
def test_killed_at_random_times_until_it_is_done(tmp_path):
    """kill -9 from outside, also in the middle of Arrow's own writes."""
    rng = random.Random(0)
    process = start_making(tmp_path / "reference")
    assert process.stdout is not None
    process.stdout.readline()
    begin = time.monotonic()
    process.wait()
    duration_s = time.monotonic() - begin
    reference = tree_hashes(tmp_path / "reference")
    kills = 0
    for number in range(6):
        root = tmp_path / f"run-{number}"
        log = tmp_path / f"{root.name}.log"
        finished: set[int] = set()
        while True:
            log.write_text("")
            process = start_making(root)
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(rng.uniform(0.0, 1.5 * duration_s))
            if process.poll() is None:
                os.kill(process.pid, signal.SIGKILL)
            status = process.wait()
            assert status in (0, -signal.SIGKILL)
            assert not finished & logged(root, "make")
            finished |= logged(root, "done") | staged_motions(root)
            kills += status != 0
            if status == 0:
                break
        assert tree_hashes(root) == reference
    assert kills > 3


def start_making(root: Path) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", MAKE_SHARD, str(root)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
