"""A configuration says what differs from another one: `extends: NAME.yaml`, merged key by key.

Mappings are merged; text, numbers, lists and null take the place of what they extend, and so does a
`Replacement`, which is a mapping marked `!replace` in YAML: for a section of another kind.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shards.configuration.presets import config_file
from shards.settings import Origins, SettingsError

__all__ = ["MergedSettings", "Replacement", "merge_layers", "read_layers"]

EXTENDS = "extends"


class Replacement(dict[Any, Any]):
    """A mapping that takes the place of the one it extends, instead of being merged with it."""


@dataclass(frozen=True, kw_only=True)
class MergedSettings:
    """What the files of a chain say together, and which of them says what."""

    data: dict[str, Any]
    origins: Origins


def read_layers(
    name: str | Path, presets: Path, parse: Callable[[str, str], object], *, beside: Path = Path()
) -> MergedSettings:
    """Read the configuration `name` (see `config_file`) and all that it extends.

    `parse` makes plain content of a file's text; its second argument names the file in errors.
    Raises SettingsError.
    """
    path = config_file(name, presets, beside=beside)
    layers: list[tuple[str, Mapping[str, Any]]] = []
    read: list[Path] = []
    while True:
        if path.resolve() in read:
            chain = " -> ".join([*(where for where, _ in reversed(layers)), str(path)])
            raise SettingsError(f"{chain}: extends itself; expected a chain that ends in a complete file")
        read.append(path.resolve())
        content = dict(_mapping(path, parse))
        parent = content.pop(EXTENDS, None)
        layers.insert(0, (str(path), content))
        if parent is None:
            return merge_layers(layers)
        path = _parent_file(parent, presets, path)


def merge_layers(layers: Sequence[tuple[str, Mapping[str, Any]]]) -> MergedSettings:
    """Contents of named files, each laid over those before it."""
    data: dict[str, Any] = {}
    files: dict[str, tuple[str, ...]] = {}
    for where, content in layers:
        _lay_over(data, content, where, "", files)
    return MergedSettings(data=data, origins=Origins(files))


def _lay_over(
    below: dict[str, Any], above: Mapping[str, Any], where: str, key: str, files: dict[str, tuple[str, ...]]
) -> None:
    """Change `below`, the mapping at the dotted `key`, by what the file `where` says about it."""
    files[key] = (where, *files.get(key, ()))
    for name, value in above.items():
        inner = f"{key}.{name}" if key else str(name)
        is_mapping = isinstance(value, Mapping)
        if not (is_mapping and isinstance(below.get(name), dict)) or isinstance(value, Replacement):
            for gone in [known for known in files if known == inner or known.startswith(f"{inner}.")]:
                del files[gone]
            below[name] = {} if is_mapping else value
        if is_mapping:
            _lay_over(below[name], value, where, inner, files)
        else:
            files[inner] = (where,)


def _mapping(path: Path, parse: Callable[[str, str], object]) -> Mapping[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise SettingsError(f"{path}: expected UTF-8 text, found something else: {error}") from error
    content = parse(text, str(path))
    if not isinstance(content, Mapping):
        raise SettingsError(f"{path}: expected a mapping of settings, found {type(content).__name__}")
    return content


def _parent_file(parent: object, presets: Path, path: Path) -> Path:
    """The file that `path` extends; a path is relative to the folder of the file that names it."""
    if not isinstance(parent, str):
        raise SettingsError(f"{path}: '{EXTENDS}': expected a preset's name or a file, found {parent!r}")
    try:
        return config_file(parent, presets, beside=path.parent)
    except SettingsError as error:
        raise SettingsError(f"{path}: '{EXTENDS}': {error}") from error
