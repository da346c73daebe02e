"""From the `objects` section of a configuration to an object library."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from datagen.objects.library import MeshFolder, ObjectLibrary, StarterPack, Sweethome3D

__all__ = ["ObjectsConfig", "open_library"]

DEFAULT_CACHE = Path("~/.cache/forehoi/objects")


@dataclass(frozen=True, kw_only=True)
class ObjectsConfig:
    """Where the objects come from."""

    source: Literal["starter", "folder", "sweethome3d"]
    path: Path | None  # folder of meshes, or root of an unpacked Debian package; null: the default place
    unit: Literal["auto", "m", "cm", "mm"]  # of unit-less files in a folder
    cache_dir: Path | None  # convex parts and solids; null: ~/.cache/forehoi/objects
    exclude: tuple[str, ...]  # uids that are left out
