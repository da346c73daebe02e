"""From the `objects` section of a configuration to an object library."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from datagen.objects.errors import ObjectError
from datagen.objects.formats.reading import ReadingConfig
from datagen.objects.mesh.registration import RegistrationConfig
from datagen.objects.stores.folder import MeshFolder, folder_state
from datagen.objects.stores.graspxl_objects import GraspXLObjects
from datagen.objects.stores.library import ObjectLibrary, StarterPack, Sweethome3D
from datagen.objects.stores.objaverse import ObjaverseStore, objaverse_root
from datagen.objects.watertight.preparation import PreparationConfig
from datagen.sources.motions import MotionsConfig, graspxl_root

__all__ = ["ObjectsConfig", "library_state", "open_library"]

DEFAULT_CACHE = Path("~/.cache/forehoi/objects")


@dataclass(frozen=True, kw_only=True)
class ObjectsConfig:
    """Where the objects come from."""

    source: Literal["starter", "folder", "sweethome3d", "objaverse", "graspxl"]
    path: Path | None  # folder of meshes, or root of an unpacked Debian package; null: the default place
    objaverse_root: Path | None  # store of the objaverse package; null: $OBJAVERSE, else its default place
    textures: Literal["none", "when_present", "required"]  # graspxl: drawn with the originals of the store
    registration: RegistrationConfig  # graspxl: how an original is matched onto the recorded mesh
    reading: ReadingConfig  # folder, objaverse and graspxl
    preparation: PreparationConfig  # all but the starter pack, which is prepared
    cache_dir: Path | None  # watertight meshes and convex parts; null: ~/.cache/forehoi/objects
    exclude: tuple[str, ...]  # uids that are left out


def open_library(config: ObjectsConfig, motions: MotionsConfig) -> ObjectLibrary:
    """The library that `config` names. Raises ObjectError or InputError when it is not there."""
    cache_dir = (config.cache_dir or DEFAULT_CACHE).expanduser()
    if config.source == "starter":
        return StarterPack()
    if config.source == "folder":
        return MeshFolder(_folder(config), config.reading, config.preparation, cache_dir)
    if config.source == "sweethome3d":
        return Sweethome3D(config.path, config.preparation, cache_dir)
    if config.source == "objaverse":
        return ObjaverseStore(config.objaverse_root, config.reading, config.preparation, cache_dir)
    return _graspxl(config, motions, cache_dir)


def _graspxl(config: ObjectsConfig, motions: MotionsConfig, cache_dir: Path) -> GraspXLObjects:
    # Also without textures: its metadata tell the licence of what a bare mesh derives from.
    there = (objaverse_root(config.objaverse_root) / "glbs").is_dir()
    store = None
    if there or config.textures == "required":
        store = ObjaverseStore(config.objaverse_root, config.reading, config.preparation, cache_dir)
    return GraspXLObjects(
        graspxl_root(motions.graspxl_root),
        store,
        textures=config.textures,
        reading=config.reading,
        preparation=config.preparation,
        registration=config.registration,
        cache_dir=cache_dir,
    )


def library_state(config: ObjectsConfig) -> str:
    """Changes when files that decisions on objects rest on come, go or change on this machine."""
    if config.source == "folder":
        return folder_state(_folder(config))
    if config.source in ("objaverse", "graspxl"):
        root = objaverse_root(config.objaverse_root)
        found = sorted((root / "metadata").glob("*"))
        found += sorted((root / "glbs").glob("*/*.glb")) if config.textures != "none" else []
    else:
        return ""  # packages: their content does not change by itself
    digest = hashlib.sha256()
    for path in found:
        known = path.stat() if path.exists() else path.lstat()  # a link may lead nowhere
        digest.update(
            f"{path.name} {known.st_size} {known.st_mtime_ns}\n".encode("utf-8", "backslashreplace")
        )
    return digest.hexdigest()


def _folder(config: ObjectsConfig) -> Path:
    if config.path is None:
        raise ObjectError(
            "objects.path",
            "is not set",
            expected="the folder that holds the meshes",
            action="Set it beside `source: folder`.",
        )
    return config.path.expanduser()
