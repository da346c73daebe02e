"""The tensors of one network, wherever they are stored: one safetensors file, several, or a file of torch.save."""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from model.errors import ModelError
from model.tensor_files.file_content import check_file, content_of
from model.tensor_files.safetensors_file import check_finite, read_header, read_tensors
from model.tensor_files.torch_file import read_torch_tensors
from model.weights.json_file import read_json_object
from model.weights.training_run import check_is_weights

__all__ = ["INDEX_SUFFIX", "TORCH_SUFFIXES", "StoredTensors", "open_stored", "plain_stem", "whole_set"]

INDEX_SUFFIX = ".safetensors.index.json"
TORCH_SUFFIXES = (".pt", ".pth", ".ckpt", ".bin")
_SET = re.compile(r"(?P<stem>.+)-(?P<number>\d{5})-of-(?P<count>\d{5})\.safetensors")
_WRAPPERS = ("module.", "_orig_mod.")  # of DistributedDataParallel and torch.compile


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredTensors:
    """What is stored, and how to read it once it is known to fit."""

    path: Path
    shapes: Mapping[str, tuple[int, ...]]  # by the names in the module
    prefix: str  # that every name had in the file beyond these, cut off
    _read: Callable[[dict[str, str]], dict[str, Tensor]]  # new names by the file's own

    def read(self, names: Iterable[str]) -> dict[str, Tensor]:
        """Tensors as stored. ModelError when one is not finite."""
        return self._read({self.prefix + name: name for name in names})


def whole_set(path: Path) -> Path:
    """The index of a set of files for each of its files; the first file where there is no index; else `path`."""
    match = _SET.fullmatch(path.name)
    if match is None:
        return path
    index = path.with_name(match["stem"] + INDEX_SUFFIX)
    return (
        index if index.is_file() else path.with_name(f"{match['stem']}-00001-of-{match['count']}.safetensors")
    )


def plain_stem(path: Path) -> str:
    """The name without what says the format or the number in a set."""
    if path.name.endswith(INDEX_SUFFIX):
        return path.name.removesuffix(INDEX_SUFFIX)
    match = _SET.fullmatch(path.name)
    return path.stem if match is None else match["stem"]


def open_stored(path: Path, *, expected: str, action: str) -> StoredTensors:
    """Names and shapes of what is stored under `path`: a file, an index of several, or one of a set.

    ModelError when a file is missing, no complete file of tensors, not fully downloaded, or holds other than floats.
    """
    check_file(path, expected=expected, action=action)
    check_is_weights(path)
    if path.name.endswith(INDEX_SUFFIX):
        return _of_files(path, _files_of_index(path), expected=expected, action=action)
    if match := _SET.fullmatch(path.name):
        names = [
            f"{match['stem']}-{n:05d}-of-{match['count']}.safetensors"
            for n in range(1, int(match["count"]) + 1)
        ]
        return _of_files(path, [path.with_name(name) for name in names], expected=expected, action=action)
    content = content_of(path)
    if content == "torch" or (content == "other" and path.suffix in TORCH_SUFFIXES):
        return _of_torch(path, expected=expected, action=action)
    return _of_files(path, [path], expected=expected, action=action)


def _of_files(path: Path, files: Iterable[Path], *, expected: str, action: str) -> StoredTensors:
    shapes: dict[str, tuple[int, ...]] = {}
    places: dict[str, Path] = {}
    for file in files:
        _check_downloaded(file, expected=expected)
        for name, shape in read_header(file, expected=expected, action=action).shapes.items():
            if name in places:
                raise ModelError(
                    path,
                    f"{name} is in both {places[name].name} and {file.name}",
                    expected="every tensor once",
                    action="The files are of different sets: download them again.",
                )
            shapes[name], places[name] = shape, file

    def read(names: dict[str, str]) -> dict[str, Tensor]:
        found: dict[str, Tensor] = {}
        for file in dict.fromkeys(places[name] for name in names):
            found |= read_tensors(file, {name: new for name, new in names.items() if places[name] == file})
        return found

    return _unwrapped(path, shapes, read)


def _of_torch(path: Path, *, expected: str, action: str) -> StoredTensors:
    _check_downloaded(path, expected=expected)
    tensors = read_torch_tensors(path, expected=expected, action=action)

    def read(names: dict[str, str]) -> dict[str, Tensor]:
        found = {new: tensors[name] for name, new in names.items()}
        check_finite(path, found)
        return found

    return _unwrapped(path, {name: tuple(tensor.shape) for name, tensor in tensors.items()}, read)


def _unwrapped(
    path: Path, shapes: Mapping[str, tuple[int, ...]], read: Callable[[dict[str, str]], dict[str, Tensor]]
) -> StoredTensors:
    """Under the names of the module that was wrapped when it was saved."""
    prefix = ""
    while wrapper := next(
        (w for w in _WRAPPERS if shapes and all(n.startswith(prefix + w) for n in shapes)), ""
    ):
        prefix += wrapper
    unwrapped = {name.removeprefix(prefix): shape for name, shape in shapes.items()}
    return StoredTensors(path=path, shapes=unwrapped, prefix=prefix, _read=read)


def _files_of_index(path: Path) -> list[Path]:
    expected = "an index of safetensors files with a weight_map of tensors to file names"
    names = read_json_object(path, expected=expected).get("weight_map")
    files = list(dict.fromkeys(names.values())) if isinstance(names, dict) else []
    if not files or not all(isinstance(name, str) and name == Path(name).name for name in files):
        problem = "has no weight_map to files of its own folder"
        raise ModelError(path, problem, expected=expected, action="Download it again, with its files.")
    return [path.with_name(name) for name in files]


def _check_downloaded(path: Path, *, expected: str) -> None:
    """aria2 writes at full length from the start; what is not there yet is zeros, which look like weights."""
    control = path.with_name(f"{path.name}.aria2")
    if control.exists():
        problem = f"is still being downloaded, or was interrupted: {control.name} lies beside it"
        raise ModelError(path, problem, expected=expected, action="Finish the download with aria2.")
