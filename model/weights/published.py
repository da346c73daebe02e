"""Published safetensors into our weight files: every key is accounted for, or nothing is written.

Our modules carry the published parameter names, so a file fits exactly when names and shapes are equal. What these
do not say (attention heads, windows) is compared with the JSON that TRELLIS puts beside a file.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path

from torch import Tensor, nn

from model.errors import ModelError
from model.tensor_files.safetensors_file import (
    KeyComparison,
    compare_keys,
    read_header,
    read_tensors,
    shapes_of,
)
from model.weights.weight_file import write_weight_file

__all__ = [
    "ImportReport",
    "ImportedFile",
    "PublishedFiles",
    "PublishedNetwork",
    "find_published",
    "import_networks",
    "prefixed",
    "published_shapes",
]

Shapes = Mapping[str, tuple[int, ...]]


@dataclass(frozen=True, kw_only=True, eq=False)
class PublishedNetwork:
    """One published network and the module of ours that its file fits."""

    name: str  # published files begin with it
    shapes: Shapes  # as published
    class_names: tuple[str, ...]  # in the JSON beside the file
    arguments: Mapping[str, object]  # what that JSON must say, where it says it
    module: nn.Module  # of our configuration, without weights
    new: tuple[str, ...]  # ours beside it, which keep their initial values
    convert: Callable[[Path, dict[str, Tensor]], dict[str, Tensor]]  # its tensors to those of our files


@dataclass(frozen=True, kw_only=True)
class PublishedFiles:
    """What a source offers: the file of each network by its name, and files that are none of them."""

    found: dict[str, Path]
    ignored: tuple[Path, ...]


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
    key_list: Path  # JSON: every key


def published_shapes(name: str) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a network of TRELLIS-image-large, e.g. "ss_enc_conv3d_16l8" or "slat_enc_swin8_B_64l8"."""
    stage = name.partition("_")[0]
    manifest = json.loads((files("model.weights") / "data" / f"trellis_{stage}.json").read_text("utf-8"))
    return {key: tuple(shape) for key, shape in manifest[name].items()}


def prefixed(group: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Published tensors under a group of our files."""
    return {group + name: tensor for name, tensor in tensors.items()}


def find_published(source: Path, networks: Sequence[PublishedNetwork]) -> PublishedFiles:
    """The files of networks in a folder (or its `ckpts`), or one such file. ModelError: there is none, or one twice."""
    if source.is_file():
        return PublishedFiles(found={_network_of_file(source, networks).name: source}, ignored=())
    if not source.is_dir():
        raise _unusable(source, "there is no such file or folder", networks)
    paths = sorted([*source.glob("*.safetensors"), *(source / "ckpts").glob("*.safetensors")])
    found: dict[str, Path] = {}
    ignored = []
    for path in paths:
        network = _network_by_name(path, networks)
        if network is None:
            ignored.append(path)
        elif network.name in found:
            raise ModelError(
                source,
                f"holds {network.name} twice: {found[network.name].name} and {path.name}",
                expected="one file of each network",
                action="Keep one of them.",
            )
        else:
            found[network.name] = path
    if not found:
        raise _unusable(
            source, f"holds none of the published networks among {len(paths)} safetensors files", networks
        )
    return PublishedFiles(found=found, ignored=tuple(ignored))


def import_networks(source: Path, networks: Sequence[PublishedNetwork], out: Path) -> ImportReport:
    """Write the weight file `out`, and beside it `*.keys.json` with what became of every key.

    The list is also written when a file does not fit; then ModelError, and no weight file.
    """
    published = find_published(source, networks)
    present = [network for network in networks if network.name in published.found]
    imported = tuple(_compared(network, published.found[network.name]) for network in present)
    key_list = _write_key_list(out.with_suffix(".keys.json"), imported)
    for network, file in zip(present, imported):
        _require_complete(network, file, key_list)
    tensors: dict[str, Tensor] = {}
    for network, file in zip(present, imported):
        tensors |= network.convert(
            file.path, read_tensors(file.path, {name: name for name in file.keys.used})
        )
    write_weight_file(out, tensors, sources={file.network: file.path.name for file in imported})
    absent = tuple(network.name for network in networks if network not in present)
    return ImportReport(imported=imported, absent=absent, ignored=published.ignored, key_list=key_list)


def _network_by_name(path: Path, networks: Sequence[PublishedNetwork]) -> PublishedNetwork | None:
    return next((network for network in networks if path.name.startswith(network.name)), None)


def _network_of_file(path: Path, networks: Sequence[PublishedNetwork]) -> PublishedNetwork:
    """By its name, else by the JSON beside it."""
    network = _network_by_name(path, networks)
    if network is None:
        class_name = _description(path).get("name")
        network = next((network for network in networks if class_name in network.class_names), None)
    if network is None:
        raise _unusable(
            path, "is none of the published networks, by its name and by the JSON beside it", networks
        )
    return network


def _description(path: Path) -> dict[str, object]:
    """The JSON that TRELLIS puts beside its files: class name and arguments; empty when there is none."""
    json_path = path.with_suffix(".json")
    if not json_path.is_file():
        return {}
    try:
        content = json.loads(json_path.read_text("utf-8"))
    except ValueError as error:
        content, reason = None, str(error)
    else:
        reason = "no mapping"
    if not isinstance(content, dict):
        raise ModelError(
            json_path,
            f"cannot be read ({reason})",
            expected="the JSON of the checkpoint",
            action="Copy it again.",
        )
    return content


def _compared(network: PublishedNetwork, path: Path) -> ImportedFile:
    description = _description(path)
    class_name = description.get("name", network.class_names[0])
    if class_name not in network.class_names:
        raise ModelError(
            path,
            f"is a {class_name}, by the JSON beside it",
            expected=f"{network.class_names[0]} ({network.name})",
            action="Give the published file under its own name.",
        )
    arguments = description.get("args")
    for name, expected in network.arguments.items():
        said = arguments.get(name, expected) if isinstance(arguments, dict) else expected
        if said != expected:
            raise ModelError(
                path,
                f"has {name} {said}, by the JSON beside it",
                expected=f"{expected}, as this configuration",
                action="Change the configuration: the network would compute something else.",
            )
    keys = compare_keys(_shapes(path, network), shapes_of(network.module))
    return ImportedFile(network=network.name, path=path, keys=keys, new=network.new)


def _require_complete(network: PublishedNetwork, file: ImportedFile, key_list: Path) -> None:
    if file.keys.complete:
        return
    if _shapes(file.path, network) == network.shapes:
        action = "The file is the published one: import it with --config paper or paper_slat."
    else:
        action = f"Every key is in {key_list}; give the unmodified {network.name}_fp16.safetensors."
    count = len(file.keys.used) + len(file.keys.missing) + len(file.keys.mismatched)
    raise ModelError(
        file.path,
        file.keys.problem(),
        expected=f"the {count} tensors of {network.name} in this configuration",
        action=action,
    )


def _shapes(path: Path, network: PublishedNetwork) -> dict[str, tuple[int, ...]]:
    return read_header(path, expected=network.name, action=_download([network])).shapes


def _write_key_list(path: Path, imported: tuple[ImportedFile, ...]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {
        file.network: {"file": str(file.path), **asdict(file.keys), "new": file.new} for file in imported
    }
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return path


def _unusable(source: Path, problem: str, networks: Sequence[PublishedNetwork]) -> ModelError:
    names = ", ".join(network.name for network in networks)
    return ModelError(source, problem, expected=f"safetensors of {names}", action=_download(networks))


def _download(networks: Sequence[PublishedNetwork]) -> str:
    names = ", ".join(f"{network.name}_fp16" for network in networks)
    return f"Download from TRELLIS-image-large/ckpts: {names} (.safetensors and .json)."
