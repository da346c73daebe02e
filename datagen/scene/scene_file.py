"""A Scene as one file: JSON header, arrays and image bytes in an .npz without pickle."""

import dataclasses
import hashlib
import json
import types
import typing
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from datagen.scene.scene import Scene
from shards.storage.whole_file import write_whole

__all__ = ["SCENE_FILE_VERSION", "SceneFileError", "load_scene", "save_scene", "scene_sha256"]

SCENE_FILE_VERSION = 3


class SceneFileError(ValueError):
    """A scene file cannot be read; the message names the file and what to do."""


def save_scene(scene: Scene, path: Path) -> None:
    """Write `scene` to `path` (.npz) in one step: the file is either complete or absent."""
    blobs: list[np.ndarray] = []
    tree = _encode(scene, blobs)
    header = {"version": SCENE_FILE_VERSION, "sha256": _digest(tree, blobs), "scene": tree}
    arrays = {f"blob_{index}": blob for index, blob in enumerate(blobs)}
    with write_whole(path) as partial, partial.open("wb") as file:
        np.savez(file, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)


def load_scene(path: Path) -> Scene:
    """Read what `save_scene` wrote, equal to the last bit. Raises SceneFileError."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            header = json.loads(archive["header"].tobytes())
            if header["version"] != SCENE_FILE_VERSION:
                raise SceneFileError(
                    f"{path}: scene file version {header['version']}, this program reads "
                    f"{SCENE_FILE_VERSION}; write the scene again with this version"
                )
            blobs = [archive[f"blob_{index}"] for index in range(len(archive.files) - 1)]
            if _digest(header["scene"], blobs) != header["sha256"]:
                raise SceneFileError(f"{path}: content does not match its sha256; write the scene again")
            scene: Scene = _decode(header["scene"], Scene, blobs)
            return scene
    except FileNotFoundError as error:
        raise SceneFileError(f"{path}: no such scene file") from error
    except (OSError, EOFError, KeyError, TypeError, RuntimeError, zipfile.BadZipFile) as error:
        raise SceneFileError(f"{path}: not a complete scene file ({error}); write it again") from error
    except ValueError as error:
        if isinstance(error, SceneFileError):
            raise
        raise SceneFileError(f"{path}: not a scene file ({error}); write it again") from error


def scene_sha256(scene: Scene) -> str:
    """Hash of everything in the scene; equal scenes give equal hashes on every machine."""
    blobs: list[np.ndarray] = []
    return _digest(_encode(scene, blobs), blobs)


def _digest(tree: Any, blobs: list[np.ndarray]) -> str:
    sha = hashlib.sha256(json.dumps(tree, sort_keys=True).encode())
    for blob in blobs:
        little_endian = blob.astype(blob.dtype.newbyteorder("<"), copy=False)
        sha.update(f"{little_endian.dtype.str}{blob.shape}".encode())
        sha.update(np.ascontiguousarray(little_endian).data)
    return sha.hexdigest()


def _encode(value: Any, blobs: list[np.ndarray]) -> Any:
    """Dataclasses to dicts, tuples to lists; arrays and bytes to {"blob": index into `blobs`}."""
    if dataclasses.is_dataclass(value):
        return {f.name: _encode(getattr(value, f.name), blobs) for f in dataclasses.fields(value)}
    if isinstance(value, tuple):
        return [_encode(item, blobs) for item in value]
    if isinstance(value, bytes):
        value = np.frombuffer(value, np.uint8)
    if isinstance(value, np.ndarray):
        blobs.append(value)
        return {"blob": len(blobs) - 1}
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, str | int | float):
        return value
    raise TypeError(f"a Scene cannot hold {type(value).__name__}")


def _decode(tree: Any, hint: Any, blobs: list[np.ndarray]) -> Any:
    """Inverse of `_encode`, led by the type annotations of the dataclasses."""
    if isinstance(hint, types.UnionType):
        return None if tree is None else _decode(tree, typing.get_args(hint)[0], blobs)
    if dataclasses.is_dataclass(hint):
        hints = typing.get_type_hints(hint)
        fields = {name: _decode(tree[name], hints[name], blobs) for name in tree}
        return hint(**fields)  # type: ignore[operator]
    if typing.get_origin(hint) is tuple:
        items = typing.get_args(hint)
        hints_of = [items[0]] * len(tree) if items[-1] is Ellipsis else items
        return tuple(_decode(item, item_hint, blobs) for item, item_hint in zip(tree, hints_of))
    if isinstance(tree, dict):
        blob = blobs[tree["blob"]]
        return blob.tobytes() if hint is bytes else blob
    return float(tree) if hint is float else tree
