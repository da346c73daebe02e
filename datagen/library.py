"""From the `objects` section of a configuration to an object library."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from datagen.objects.library import MeshFolder, ObjectLibrary, StarterPack, Sweethome3D
from datagen.objects.preparation import PreparationConfig
from datagen.objects.reading import ReadingConfig

__all__ = ["ObjectsConfig", "open_library"]

DEFAULT_CACHE = Path("~/.cache/forehoi/objects")


@dataclass(frozen=True, kw_only=True)
class ObjectsConfig:
    """Where the objects come from."""

    source: Literal["starter", "folder", "sweethome3d"]
    path: Path | None  # folder of meshes, or root of an unpacked Debian package; null: the default place
    reading: ReadingConfig  # folder only
    preparation: PreparationConfig  # folder and sweethome3d; the starter pack is prepared
    cache_dir: Path | None  # solids and convex parts; null: ~/.cache/forehoi/objects
    exclude: tuple[str, ...]  # uids that are left out


def open_library(config: ObjectsConfig) -> ObjectLibrary:
    """The library that `config` names. Raises ObjectError when it is not there."""
    cache_dir = (config.cache_dir or DEFAULT_CACHE).expanduser()
    if config.source == "starter":
        return StarterPack()
    if config.source == "folder":
        return MeshFolder(config.path or Path(), config.reading, config.preparation, cache_dir)
    return Sweethome3D(config.path, config.preparation, cache_dir)
