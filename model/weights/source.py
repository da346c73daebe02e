"""Which file of a source is which published network.

A source is a release folder, its `ckpts`, a clone, a model in the cache of the hub, the output folder of a training of
TRELLIS, or a single file.
"""

import os
import stat
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from model.errors import ModelError
from model.tensor_files.safetensors_file import compare_keys, shapes_of
from model.weights.hub_cache import cached_snapshot, unfinished_downloads
from model.weights.published import PublishedNetwork, description, other_release
from model.weights.stored_tensors import INDEX_SUFFIX, TORCH_SUFFIXES, StoredTensors, open_stored, whole_set
from model.weights.training_run import RunCheckpoint, chosen_checkpoints, run_checkpoint

__all__ = ["PublishedFiles", "download_action", "find_published", "unusable"]

_SUFFIXES = (".safetensors", INDEX_SUFFIX, *TORCH_SUFFIXES)


@dataclass(frozen=True, kw_only=True)
class PublishedFiles:
    """What a source offers: the file of each network by its name, files that are none of them, and notes."""

    found: dict[str, Path]
    ignored: tuple[Path, ...]
    notes: tuple[str, ...]


def find_published(source: Path, networks: Sequence[PublishedNetwork]) -> PublishedFiles:
    """The files of networks in a source. ModelError: there is none, one twice, or it cannot be read."""
    try:
        mode = source.stat().st_mode
    except OSError as error:
        problem = f"cannot be read ({error.strerror})"
        if isinstance(error, FileNotFoundError):
            is_link = os.path.islink(source)
            problem = (
                "is a link to something that is not there" if is_link else "there is no such file or folder"
            )
        raise unusable(source, problem, networks) from error
    if not stat.S_ISDIR(mode):
        return _of_file(whole_set(source), networks)
    try:
        snapshot = cached_snapshot(source)
        paths = _weight_files(snapshot.folder)
        unfinished = unfinished_downloads(source, snapshot.folder)
    except OSError as error:
        raise unusable(source, f"cannot be listed ({error.strerror})", networks) from error
    notes = [f"read from {snapshot.note}"] if snapshot.note else []
    notes += [f"not downloaded completely: {path}" for path in unfinished]
    found, ignored = _by_name(source, paths, networks)
    if found:
        return PublishedFiles(found=found, ignored=ignored, notes=tuple(notes))
    if runs := [checkpoint for path in paths if (checkpoint := run_checkpoint(path))]:
        return _of_run(source, paths, runs, networks, notes)
    raise _none_found(source, snapshot.folder, paths, unfinished, networks)


def unusable(source: Path, problem: str, networks: Sequence[PublishedNetwork]) -> ModelError:
    """The error for a source that holds none of the networks."""
    names = ", ".join(network.name for network in networks)
    return ModelError(
        source, problem, expected=f"weights of TRELLIS-image-large: {names}", action=download_action(networks)
    )


def download_action(networks: Sequence[PublishedNetwork]) -> str:
    """What to do for files that are missing or damaged."""
    names = ", ".join(f"{network.name}_fp16" for network in networks)
    return f"Download from microsoft/TRELLIS-image-large/ckpts: {names} (.safetensors and .json)."


def _weight_files(folder: Path) -> list[Path]:
    """Files of tensors in a folder and its `ckpts`, of a set of files one; also broken links and folders so named."""
    names = [
        path for place in (folder, folder / "ckpts") if place.is_dir() for path in sorted(place.iterdir())
    ]
    paths = [path for path in names if path.name.endswith(_SUFFIXES) and not path.name.startswith(".")]
    return list(dict.fromkeys(whole_set(path) for path in paths))


def _by_name(
    source: Path, paths: Sequence[Path], networks: Sequence[PublishedNetwork]
) -> tuple[dict[str, Path], tuple[Path, ...]]:
    found: dict[str, Path] = {}
    ignored = []
    for path in paths:
        network = next((network for network in networks if network.is_named(path)), None)
        if network is None:
            ignored.append(path)
        else:
            _add(found, network.name, path, source)
    return found, tuple(ignored)


def _of_file(path: Path, networks: Sequence[PublishedNetwork]) -> PublishedFiles:
    """By its name, else by the JSON beside it, else by the names of its tensors."""
    network = next((network for network in networks if network.is_named(path)), None)
    if network is not None:
        return PublishedFiles(found={network.name: path}, ignored=(), notes=())
    if release := other_release(path.name):
        raise unusable(path, f"is of another release, {release}", networks)
    class_name = description(path).get("name")
    network = next((network for network in networks if class_name in network.class_names), None)
    if network is not None:
        return PublishedFiles(found={network.name: path}, ignored=(), notes=())
    names = ", ".join(network.name for network in networks)
    stored = open_stored(path, expected=f"weights of {names}", action=download_action(networks))
    network = next((n for n in networks if shapes_of(n.module).keys() == stored.shapes.keys()), None)
    if network is None:
        raise unusable(path, f"is none of the published networks: {_closest(stored, networks)}", networks)
    note = f"{path.name} is taken for {network.name}, by the names of its tensors"
    return PublishedFiles(found={network.name: path}, ignored=(), notes=(note,))


def _of_run(
    source: Path,
    paths: Sequence[Path],
    runs: Sequence[RunCheckpoint],
    networks: Sequence[PublishedNetwork],
    notes: Sequence[str],
) -> PublishedFiles:
    """The checkpoints of a training's output folder."""
    files = [_of_file(checkpoint.path, networks) for checkpoint in chosen_checkpoints(source, runs)]
    found: dict[str, Path] = {}
    for name, path in (item for file in files for item in file.found.items()):
        _add(found, name, path, source)
    ignored = tuple(path for path in paths if path not in found.values())
    return PublishedFiles(
        found=found, ignored=ignored, notes=(*notes, *(n for file in files for n in file.notes))
    )


def _add(found: dict[str, Path], name: str, path: Path, source: Path) -> None:
    if name in found:
        raise ModelError(
            source,
            f"holds {name} twice: {found[name].name} and {path.name}",
            expected="one file of each network",
            action="Move one of them elsewhere (of two precisions keep float32, else float16 as published).",
        )
    found[name] = path


def _closest(stored: StoredTensors, networks: Sequence[PublishedNetwork]) -> str:
    comparisons = {
        network.name: compare_keys(stored.shapes, shapes_of(network.module)) for network in networks
    }
    name, keys = max(comparisons.items(), key=lambda item: len(item[1].used) + len(item[1].mismatched))
    if not keys.used and not keys.mismatched:
        return f"none of its {len(stored.shapes)} tensors has a name of theirs, first {next(iter(stored.shapes), '')}"
    return f"its name says none, and as {name} it would have {keys.problem()}"


def _none_found(
    source: Path,
    folder: Path,
    paths: Sequence[Path],
    unfinished: Sequence[Path],
    networks: Sequence[PublishedNetwork],
) -> ModelError:
    named = [name for name in (*(path.name for path in paths), source.name) if other_release(name)]
    if named:
        return unusable(source, f"is of another release, {other_release(named[0])} ({named[0]})", networks)
    if unfinished:
        return unusable(
            source, f"its download is not complete ({len(unfinished)} files, first {unfinished[0]})", networks
        )
    deeper = next(
        (place for place in sorted(folder.iterdir()) if place.is_dir() and (place / "ckpts").is_dir()), None
    )
    if deeper is not None:
        problem = "holds no weights itself"
        return ModelError(
            source, problem, expected="the folder that has ckpts in it", action=f"Give {deeper}."
        )
    where = "" if folder == source else f" in {folder}"
    names = f", first {paths[0].name}" if paths else ""
    return unusable(
        source,
        f"holds none of the published networks among {len(paths)} files of weights{where}{names}",
        networks,
    )
