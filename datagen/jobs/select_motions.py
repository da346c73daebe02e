"""Selection of a whole dataset: every candidate decided once, resumable, kept in selection.parquet."""

import difflib
import fcntl
import functools
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from datagen.config import DatasetConfig, placeless
from datagen.grasps.recorded.graspxl import SequenceFile
from datagen.input_error import InputError
from datagen.jobs.neighbour_selections import said_of_neighbours
from datagen.plan.plan import PLAN_FILE, SELECTION_FILE
from datagen.plan.same_objects import join_same_objects, said_of_same_objects
from datagen.plan.selection_rules import (
    Decision,
    decide_object,
    names_of,
    normalised_name,
    own_entries,
    read_takedown,
)
from datagen.sources.motions import recorded_sequences
from datagen.sources.objects import library_state, open_library
from shards.storage.whole_file import write_whole

__all__ = ["Selection", "select_motions"]

_PARTIAL = "selection.partial.jsonl"
_KEY, _NOTES = b"selection_key", b"notes"
_CHUNK = 64  # objects that a process takes at a time


@dataclass(frozen=True, kw_only=True)
class Selection:
    """All decisions, objects in library order, sequences in natural order."""

    decisions: tuple[Decision, ...]
    unmatched: tuple[str, ...]  # entries of the user's takedown list that name nothing here
    notes: tuple[str, ...]  # what was left out, guessed or joined, one line each

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
    instead; a run that was stopped is continued; a second process waits. `report` gets (objects
    done, objects in all). InputError when `out` holds a plan that was made from another selection.
    """
    out.mkdir(parents=True, exist_ok=True)
    with _lock(out / ".selection.lock"):
        takedown = read_takedown(config.selection.takedown)
        tasks, library_notes = _tasks(config)
        known_names = _known_names(tasks)
        _require_known_exclusions(config, known_names)
        unmatched = tuple(sorted(own_entries(config.selection.takedown) - known_names))
        key = _key(config, takedown, tasks)
        path = out / SELECTION_FILE
        known = _read(path, key, unmatched)
        if known is not None:
            return known
        if (out / PLAN_FILE).exists() and path.exists():
            raise InputError(
                path,
                "belongs to the plan beside it, and objects, recordings, rules or takedown list have changed since",
                expected="the selection that the plan was made from",
                action="Select into another --out. Rendering goes on with the plan as it is; what is taken "
                "down is skipped.",
            )
        with _progress_file(out / _PARTIAL, key) as (done, remember):
            waiting = [task for task in tasks if task.uid not in done]
            decided = _decided(config, takedown, waiting, workers)
            for count, (task, of_task) in enumerate(zip(waiting, decided)):
                remember(task.uid, of_task)
                if report is not None:
                    report(len(tasks) - len(waiting) + count + 1, len(tasks))
            decisions, same_notes = _joined(config, [d for task in tasks for d in done[task.uid]])
        notes = (*library_notes, *same_notes, *said_of_neighbours(out, decisions, config.split))
        selection = Selection(decisions=decisions, unmatched=unmatched, notes=notes)
        _write(selection, path, key)
        (out / _PARTIAL).unlink()
    return selection


@contextmanager
def _lock(path: Path) -> Iterator[None]:
    """One process at a time in this folder; the lock ends with the process."""
    with path.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _known_names(tasks: Sequence["_Task"]) -> frozenset[str]:
    """Everything that a list may name here."""
    names: set[str] = set()
    for task in tasks:
        names |= names_of(task.uid)
        names |= {file.sequence_id for file in task.sequences}
    return frozenset(names)


def _require_known_exclusions(config: DatasetConfig, known_names: frozenset[str]) -> None:
    unknown = sorted({normalised_name(entry) for entry in config.objects.exclude} - known_names)
    if unknown:
        close = difflib.get_close_matches(unknown[0], known_names, n=1)
        raise InputError(
            "objects.exclude",
            f"names {', '.join(unknown[:3])}, which the library does not have",
            expected="uids of its objects",
            action=f"Did you mean {close[0]!r}?" if close else "Take it out.",
        )


def _joined(
    config: DatasetConfig, decisions: Sequence[Decision]
) -> tuple[tuple[Decision, ...], tuple[str, ...]]:
    """What is one object becomes one where the names of objects are ours; published ones stay, and it is said."""
    if config.objects.source != "folder":
        return tuple(decisions), said_of_same_objects(decisions, config.split)
    joined, notes = join_same_objects(decisions)
    return tuple(joined), notes


def _tasks(config: DatasetConfig) -> tuple[list[_Task], tuple[str, ...]]:
    """All candidates, and what the library says of itself."""
    sequences: Mapping[str, SequenceFile] = recorded_sequences(config.motions)
    library = open_library(config.objects, config.motions)
    uids, notes = library.uids(), library.notes()
    if config.motions.source == "simulated":
        return [_Task(uid=uid, sequences=()) for uid in uids], notes
    of_object: dict[str, list[SequenceFile]] = {}
    for file in sequences.values():
        of_object.setdefault(file.object_uid, []).append(file)
    # An object without a mesh still has its say: it is removed with the reason, not overlooked.
    return [_Task(uid=uid, sequences=tuple(files)) for uid, files in sorted(of_object.items())], notes


def _key(config: DatasetConfig, takedown: frozenset[str], tasks: Sequence[_Task]) -> str:
    """Of all that decides: rules, takedown list, candidates, and what the object store holds of them."""
    somewhere = placeless(config)
    decisive = json.dumps(
        [
            asdict(somewhere.selection),
            sorted(takedown),
            asdict(somewhere.objects),
            [(task.uid, [file.sequence_id for file in task.sequences]) for task in tasks],
            library_state(config.objects),
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
    size = max(_CHUNK, len(tasks) // (16 * workers))  # opening a large store takes seconds
    chunks = [tasks[start : start + size] for start in range(0, len(tasks), size)]
    try:
        with ProcessPoolExecutor(max_workers=workers, mp_context=get_context("spawn")) as pool:
            for decided in pool.map(functools.partial(_decide_all, config, takedown), chunks):
                yield from decided
    except (BrokenProcessPool, MemoryError) as error:
        raise InputError(
            f"--workers {workers}",
            "a process that looked at objects was killed, most likely because memory ran out",
            expected="memory for as many objects at a time",
            action="Run the same command with fewer workers: what was decided is kept.",
        ) from error


def _decide(
    config: DatasetConfig, takedown: frozenset[str], tasks: Sequence[_Task]
) -> Iterator[list[Decision]]:
    library = open_library(config.objects, config.motions)
    excluded = frozenset(normalised_name(entry) for entry in config.objects.exclude)
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
        done[entry["uid"]] = [_decision_of(decision) for decision in entry["decisions"]]

    with path.open("a", encoding="utf-8") as file:
        file.write("\n")

        def remember(uid: str, decisions: list[Decision]) -> None:
            done[uid] = decisions
            entry = {"uid": uid, "decisions": [asdict(decision) for decision in decisions]}
            file.write(json.dumps(entry) + "\n")
            file.flush()

        yield done, remember


def _decision_of(stored: dict[str, Any]) -> Decision:
    """From JSON or Parquet, which have lists for tuples."""
    plain: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in stored.items()
    }
    return Decision(**plain)


def _write(selection: Selection, path: Path, key: str) -> None:
    columns = {
        field.name: [getattr(decision, field.name) for decision in selection.decisions]
        for field in fields(Decision)
    }
    metadata = {_KEY: key.encode(), _NOTES: json.dumps(selection.notes).encode()}
    table = pa.table(columns).replace_schema_metadata(metadata)
    with write_whole(path, durable=True) as partial:
        pq.write_table(table, partial, compression="zstd", write_page_checksum=True)


def _read(path: Path, key: str, unmatched: tuple[str, ...]) -> Selection | None:
    """The selection of `path` where it is of the same key; a damaged or other one is made again."""
    if not path.is_file():
        return None
    try:
        table = pq.read_table(path, page_checksum_verification=True)
        metadata = table.schema.metadata or {}
        if metadata.get(_KEY) != key.encode():
            return None
        decisions = tuple(_decision_of(row) for row in table.to_pylist())
        return Selection(decisions=decisions, unmatched=unmatched, notes=tuple(json.loads(metadata[_NOTES])))
    except (pa.ArrowException, OSError, TypeError, KeyError, ValueError):
        return None
