"""Published weights into our weight files: every key is accounted for, or nothing is written."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from safetensors import SafetensorError
from torch import Tensor

from model.errors import ModelError
from model.tensor_files.safetensors_file import KeyComparison, compare_keys, shapes_of
from model.weights.published import PublishedNetwork, description
from model.weights.source import download_action, find_published
from model.weights.stored_tensors import StoredTensors, open_stored
from model.weights.training_run import has_config, run_checkpoint
from model.weights.weight_file import write_weight_file

__all__ = ["ImportReport", "ImportedFile", "import_networks"]


@dataclass(frozen=True, kw_only=True)
class ImportedFile:
    """What became of every key of a file. `new`: tensors beside the module, which keep their initial values."""

    network: str
    path: Path
    keys: KeyComparison
    new: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class ImportReport:
    """What was imported. `ignored` are files of the source that belong to none of the networks."""

    imported: tuple[ImportedFile, ...]
    absent: tuple[str, ...]  # networks that the source does not have
    ignored: tuple[Path, ...]
    notes: tuple[str, ...]  # what was guessed, and what the source lacks
    key_list: Path  # JSON: every key


def import_networks(source: Path, networks: Sequence[PublishedNetwork], out: Path) -> ImportReport:
    """Write the weight file `out`, and beside it `*.keys.json` with what became of every key.

    The list is also written when a file does not fit; then ModelError, and no weight file.
    """
    published = find_published(source, networks)
    present = [network for network in networks if network.name in published.found]
    stored = [_stored(network, published.found[network.name]) for network in present]
    imported = tuple(_compared(network, file) for network, file in zip(present, stored))
    with _writing(out):
        key_list = _write_key_list(out.with_suffix(".keys.json"), imported)
    for network, tensors, file in zip(present, stored, imported):
        _require_complete(network, tensors, file, key_list)
    converted: dict[str, Tensor] = {}
    for network, tensors in zip(present, stored):
        converted |= network.convert(tensors.path, tensors.read(tensors.shapes))
    with _writing(out):
        write_weight_file(out, converted, sources={file.network: file.path.name for file in imported})
    return ImportReport(
        imported=imported,
        absent=tuple(network.name for network in networks if network not in present),
        ignored=published.ignored,
        notes=(*published.notes, *(note for tensors in stored for note in _notes(tensors))),
        key_list=key_list,
    )


@contextmanager
def _writing(out: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, SafetensorError) as error:
        reason = " ".join(str(error).split())
        action = "Choose another --out, or make room."
        raise ModelError(
            out, f"cannot be written ({reason})", expected="a new file", action=action
        ) from error


def _stored(network: PublishedNetwork, path: Path) -> StoredTensors:
    return open_stored(path, expected=network.name, action=download_action([network]))


def _notes(tensors: StoredTensors) -> list[str]:
    notes = []
    if tensors.prefix:
        notes.append(f"{tensors.path.name}: every name without its '{tensors.prefix}'")
    if run_checkpoint(tensors.path) and not has_config(tensors.path):
        notes.append(
            f"{tensors.path.name}: no config.json of its training was found; heads and the normalisation of latents "
            "are taken for the published ones"
        )
    return notes


def _compared(network: PublishedNetwork, stored: StoredTensors) -> ImportedFile:
    said = description(stored.path)
    class_name = said.get("name", network.class_names[0])
    if class_name not in network.class_names:
        raise ModelError(
            stored.path,
            f"is a {class_name}, by the JSON beside it",
            expected=f"{network.class_names[0]} ({network.name})",
            action="Give the published file under its own name.",
        )
    arguments = said.get("args")
    for name, expected in network.arguments.items():
        found = arguments.get(name, expected) if isinstance(arguments, dict) else expected
        if found != expected:
            raise ModelError(
                stored.path,
                f"has {name} {found}, by the JSON beside it",
                expected=f"{expected}, as this configuration",
                action="Change the configuration: the network would compute something else.",
            )
    keys = compare_keys(stored.shapes, shapes_of(network.module))
    return ImportedFile(network=network.name, path=stored.path, keys=keys, new=network.new)


def _require_complete(
    network: PublishedNetwork, stored: StoredTensors, file: ImportedFile, key_list: Path
) -> None:
    if file.keys.complete:
        return
    if dict(stored.shapes) == network.shapes:
        action = "The file is the published one: import it with --config paper or paper_slat."
    else:
        action = f"Every key is in {key_list}; give the unmodified {network.name}_fp16.safetensors."
    count = len(file.keys.used) + len(file.keys.missing) + len(file.keys.mismatched)
    raise ModelError(
        file.path,
        f"does not fit: {file.keys.problem()}",
        expected=f"the {count} tensors of {network.name} in this configuration",
        action=action,
    )


def _write_key_list(path: Path, imported: tuple[ImportedFile, ...]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {
        file.network: {"file": str(file.path), **asdict(file.keys), "new": file.new} for file in imported
    }
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return path
