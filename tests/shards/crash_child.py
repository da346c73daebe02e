"""Makes a small shard and dies on the way: at the k-th change to the file system, for every k
(or every STEP-th).

Run as a program by test_crash.py. Each attempt is a forked copy of this process that kills itself
with SIGKILL just before its k-th file-system call; then a second copy resumes and must finish.
Prints one JSON line: kill points tried, and what went wrong at which of them.
"""

import hashlib
import json
import os
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from shards.reader import open_dataset
from shards.verify import verify_shard
from shards.writer import (
    begin_dataset,
    commit_shard,
    is_motion_staged,
    stage_motion,
    stage_skipped_motion,
)
from tests.shards.synthetic import PROVENANCE, SPLIT_RULE, dataset_record, synthetic_clip, synthetic_object

N_MOTIONS = 3  # the last one is skipped
EVENTS = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir"}


def rows(motion_index: int) -> tuple:
    object_row = synthetic_object(0)
    clip, frames = synthetic_clip(object_row, motion_index, 0, 2, 24)
    return object_row, [clip], frames


ROWS = [rows(i) for i in range(N_MOTIONS - 1)]


def make_shard(root: Path) -> None:
    """What a generator does: stage what is not staged, then commit. Logs every motion it makes."""
    begin_dataset(root, dataset_record())
    for index in range(N_MOTIONS):
        if (root / "shards/shard-00000/shard.json").exists() or is_motion_staged(root, 0, index, PROVENANCE):
            continue
        write_log(root, f"make {index}")
        keys: dict[str, Any] = {"timings_s": {"render": 1.0}, "provenance": PROVENANCE}
        if index == N_MOTIONS - 1:
            stage_skipped_motion(root, 0, index, reason="no grasp was found", **keys)
        else:
            object_row, clips, frames = ROWS[index]
            stage_motion(root, 0, index, object_row=object_row, clips=clips, frames=frames, **keys)
        write_log(root, f"done {index}")
    commit_shard(root, 0, motion_indices=range(N_MOTIONS), provenance=PROVENANCE)


def write_log(root: Path, line: str) -> None:
    with (root.parent / f"{root.name}.log").open("a") as log:
        log.write(line + "\n")


def logged(root: Path, what: str) -> set[int]:
    """Motions that were begun ("make") or finished ("done")."""
    path = root.parent / f"{root.name}.log"
    lines = [line.split() for line in path.read_text().splitlines()] if path.exists() else []
    return {int(index) for kind, index in lines if kind == what}


def die_before_event(number: int, root: Path) -> None:
    """SIGKILL this process just before its `number`-th file-system call below `root`."""
    count = 0

    def hook(event: str, arguments: tuple) -> None:
        nonlocal count
        path = str(arguments[0])
        # shutil.rmtree passes bare names, relative to a folder it holds open.
        if event in EVENTS and (path.startswith(str(root)) or "/" not in path):
            count += 1
            if count == number:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)


def in_fork(work: Callable[[], None]) -> int:
    """Run `work` in a forked copy; its exit status, or minus the signal that killed it."""
    child = os.fork()
    if child == 0:
        try:
            work()
        except BaseException:
            sys.excepthook(*sys.exc_info())
            os._exit(1)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def staged_motions(root: Path) -> set[int]:
    return {int(p.parent.name[-6:]) for p in root.glob("staging/shard-00000/motion-*/motion.json")}


def tree_hashes(root: Path) -> dict[str, str]:
    # What was being written has a name of its own, as several processes may begin a dataset at once.
    litter = set(root.glob(".*.partial"))
    files = sorted(path for path in root.rglob("*") if path.is_file() and path not in litter)
    return {str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def attempt(root: Path, number: int, reference: dict[str, str]) -> tuple[bool, list[str]]:
    """(was killed, problems) of one kill and one resume."""

    def killed() -> None:
        die_before_event(number, root)
        make_shard(root)

    status = in_fork(killed)
    problems = []
    if status not in (0, -signal.SIGKILL):
        problems.append(f"ended with {status}")
    committed = (root / "shards/shard-00000/shard.json").exists()
    if committed:  # then it must be whole at this very moment
        shard = open_dataset(root).shards[0]
        problems += [str(finding) for finding in verify_shard(shard, split_rule=SPLIT_RULE).findings]
    elif (root / "dataset.json").exists() and open_dataset(root).shards:
        problems.append("an unfinished shard can be opened")
    finished = logged(root, "done") | staged_motions(root)
    (root.parent / f"{root.name}.log").write_text("")
    if in_fork(lambda: make_shard(root)) != 0:
        problems.append("the resumed run failed")
    redone = finished & logged(root, "make")
    if redone:
        problems.append(f"motions {sorted(redone)} were made again")
    if tree_hashes(root) != reference:
        problems.append("the result differs from that of an undisturbed run")
    return status == -signal.SIGKILL, problems


def main(folder: Path, step: int) -> None:
    if in_fork(lambda: make_shard(folder / "reference")) != 0:
        raise SystemExit("the undisturbed run failed")
    reference, failures = tree_hashes(folder / "reference"), {}
    was_killed, number, tried = True, 1, 0
    while was_killed:
        root = folder / f"attempt-{number}"
        was_killed, problems = attempt(root, number, reference)
        if problems:
            failures[number] = problems
        shutil.rmtree(root, ignore_errors=True)
        tried, number = tried + was_killed, number + step
    files = sorted(reference)
    print(json.dumps({"kill_points": tried, "failures": failures, "files": files}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
