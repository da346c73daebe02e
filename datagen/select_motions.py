"""Selection of a whole dataset: every candidate decided once, resumable, kept in selection.parquet."""

import functools
import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from multiprocessing import get_context
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from datagen.config import DatasetConfig
from datagen.grasps.graspxl import SequenceFile
from datagen.library import open_library
from datagen.motion_source import recorded_sequences
from datagen.selection import Decision, decide_object, read_takedown

__all__ = ["SELECTION_FILE", "Selection", "select_motions"]

SELECTION_FILE = "selection.parquet"
_PARTIAL = "selection.partial.jsonl"
_KEY = b"selection_key"
_CHUNK = 64  # objects that a process takes at a time


@dataclass(frozen=True, kw_only=True)
class Selection:
    """All decisions, objects in library order, sequences in natural order."""

    decisions: tuple[Decision, ...]

    @property
    def kept(self) -> tuple[Decision, ...]:
        return tuple(decision for decision in self.decisions if decision.kept)


@dataclass(frozen=True, kw_only=True)
class _Task:
    """One object with its recorded sequences (none: simulated)."""

    uid: str
    sequences: tuple[SequenceFile, ...]


def select_motions(
    config: DatasetConfig,
    out: Path,
    *,
    workers: int = 1,
    report: Callable[[int, int], None] | None = None,
) -> Selection:
    """Decide on every candidate of `config` and write `out`/selection.parquet.

    A file that is there and was made of the same rules, takedown list and candidates is read
    instead; a run that was stopped is continued. `report` gets (objects done, objects in all).
    """
    takedown = read_takedown(config.selection.takedown)
    tasks = _tasks(config)
    key = _key(config, takedown, tasks)
    path = out / SELECTION_FILE
    known = _read(path, key)
    if known is not None:
        return known
    out.mkdir(parents=True, exist_ok=True)
    with _progress_file(out / _PARTIAL, key) as (done, remember):
        waiting = [task for task in tasks if task.uid not in done]
        for count, (task, decisions) in enumerate(zip(waiting, _decided(config, takedown, waiting, workers))):
            remember(task.uid, decisions)
            if report is not None:
                report(len(tasks) - len(waiting) + count + 1, len(tasks))
        selection = Selection(decisions=tuple(d for task in tasks for d in done[task.uid]))
    _write(selection, path, key)
    (out / _PARTIAL).unlink()
    return selection


def _tasks(config: DatasetConfig) -> list[_Task]:
    sequences: Mapping[str, SequenceFile] = recorded_sequences(config.motions)
    uids = open_library(config.objects, config.motions).uids()
    if config.motions.source == "simulated":
        return [_Task(uid=uid, sequences=()) for uid in uids]
    of_object: dict[str, list[SequenceFile]] = {}
    for file in sequences.values():
        of_object.setdefault(file.object_uid, []).append(file)
    # An object without a mesh still has its say: it is removed with the reason, not overlooked.
    return [_Task(uid=uid, sequences=tuple(files)) for uid, files in sorted(of_object.items())]


def _key(config: DatasetConfig, takedown: frozenset[str], tasks: Sequence[_Task]) -> str:
    """Of all that decides: rules, takedown list and candidates."""
    decisive = json.dumps(
        [
            asdict(config.selection),
            sorted(takedown),
            asdict(config.objects),
            [(task.uid, [file.sequence_id for file in task.sequences]) for task in tasks],
        ],
        default=str,
    )
    return hashlib.sha256(decisive.encode()).hexdigest()


def _decided(
    config: DatasetConfig, takedown: frozenset[str], tasks: Sequence[_Task], workers: int
) -> Iterator[list[Decision]]:
    """Decisions of each task, in order; a process opens the library once per chunk."""
    decide = functools.partial(_decide, config, takedown)
    if workers == 1:
        yield from decide(tasks)
        return
    chunks = [tasks[start : start + _CHUNK] for start in range(0, len(tasks), _CHUNK)]
    with ProcessPoolExecutor(max_workers=workers, mp_context=get_context("spawn")) as pool:
        for decided in pool.map(functools.partial(_decide_all, config, takedown), chunks):
            yield from decided


def _decide(
    config: DatasetConfig, takedown: frozenset[str], tasks: Sequence[_Task]
) -> Iterator[list[Decision]]:
    library = open_library(config.objects, config.motions)
    excluded = frozenset(config.objects.exclude)
    for task in tasks:
        yield decide_object(
            task.uid, task.sequences, library, config.selection, excluded=excluded, takedown=takedown
        )


def _decide_all(
    config: DatasetConfig, takedown: frozenset[str], tasks: Sequence[_Task]
) -> list[list[Decision]]:
    return list(_decide(config, takedown, tasks))


@contextmanager
def _progress_file(
    path: Path, key: str
) -> Iterator[tuple[dict[str, list[Decision]], Callable[[str, list[Decision]], None]]]:
    """Decisions of an earlier, stopped run of the same selection, and a way to add to them."""
    done: dict[str, list[Decision]] = {}
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    if lines[:1] != [key]:
        lines = []
        path.write_text(f"{key}\n", encoding="utf-8")
    for line in lines[1:]:
        try:
            entry = json.loads(line)
        except ValueError:  # the line at which the earlier run was killed
            continue
        done[entry["uid"]] = [Decision(**decision) for decision in entry["decisions"]]

    with path.open("a", encoding="utf-8") as file:
        file.write("\n")

        def remember(uid: str, decisions: list[Decision]) -> None:
            done[uid] = decisions
            entry = {"uid": uid, "decisions": [asdict(decision) for decision in decisions]}
            file.write(json.dumps(entry) + "\n")
            file.flush()

        yield done, remember


def _write(selection: Selection, path: Path, key: str) -> None:
    columns = {
        field.name: [getattr(decision, field.name) for decision in selection.decisions]
        for field in fields(Decision)
    }
    table = pa.table(columns).replace_schema_metadata({_KEY: key.encode()})
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
        pq.write_table(table, file, compression="zstd", write_page_checksum=True)
        file.flush()
        os.fsync(file.fileno())
    os.replace(file.name, path)


def _read(path: Path, key: str) -> Selection | None:
    """The selection of `path` where it is of the same key; a damaged or other one is made again."""
    if not path.is_file():
        return None
    try:
        table = pq.read_table(path, page_checksum_verification=True)
        if (table.schema.metadata or {}).get(_KEY) != key.encode():
            return None
        return Selection(decisions=tuple(Decision(**row) for row in table.to_pylist()))
    except (pa.ArrowException, OSError, TypeError):
        return None
