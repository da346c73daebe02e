"""Object libraries: their interface, the starter pack in this package, Sweet Home 3D."""

import io
import json
import zipfile
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from datagen.objects.asset.object_asset import ObjectAsset
from datagen.objects.catalogue.description import ObjectDescription
from datagen.objects.errors import ObjectError
from datagen.objects.formats.reading import ReadingConfig, ReadObject, object_mesh
from datagen.objects.gltf.scene import read_gltf
from datagen.objects.mesh.graspable_size import holdable_scale, scaled_mesh
from datagen.objects.mesh.mesh_measures import MeshMeasures, measure_mesh
from datagen.objects.mesh.object_mesh import ObjectMesh
from datagen.objects.mesh.outward_faces import outward_mesh
from datagen.objects.mesh.texture_quality import TextureQuality, measure_texture_quality
from datagen.objects.stores.sweethome3d import CatalogueEntry, find_libraries, read_catalogue, read_model
from datagen.objects.watertight.preparation import PreparationConfig, cached_watertight, watertight_from_bytes

__all__ = ["REFERENCE_READING", "ObjectLibrary", "StarterPack", "Sweethome3D", "unknown_object"]

# Unit-less files: the "auto" rule; OBJ, PLY and STL with Y up, as most exporters write OBJ.
REFERENCE_READING = ReadingConfig(unit="auto", up_axis="y", max_faces=1_000_000, max_image_px=8192)


@runtime_checkable
class ObjectLibrary(Protocol):
    """Named objects that load the same every time."""

    def uids(self) -> tuple[str, ...]:
        """All uids in a fixed order."""

    def load(self, uid: str) -> ObjectAsset:
        """The object; ObjectError where it cannot be used or the uid is unknown."""

    def describe(self, uid: str) -> ObjectDescription:
        """What is known without reading the mesh; ObjectError where the uid is unknown."""

    def measure(self, uid: str) -> MeshMeasures:
        """What a selection rests on, without the costly parts of `load`; its `texture` is that of `load`."""

    def notes(self) -> tuple[str, ...]:
        """What was left out, guessed or joined when the library was opened, one line each."""


def unknown_object(where: object, uid: str) -> ObjectError:
    """For a uid that is not one of a library's."""
    return ObjectError(
        where, f"has no object {uid!r}", expected="one of its uids()", action="List the uids and pick one."
    )


class StarterPack:
    """The CC0 objects that ship with the package, watertight meshes and convex parts included."""

    def __init__(self) -> None:
        data = files("datagen.objects").joinpath("data", "starter_pack.zip").read_bytes()
        self._archive = zipfile.ZipFile(io.BytesIO(data))
        self._entries: dict[str, dict[str, Any]] = {
            entry["uid"]: entry for entry in json.loads(self._archive.read("index.json"))
        }

    def uids(self) -> tuple[str, ...]:
        """ "starter/<name>" of every object, sorted."""
        return tuple(self._entries)

    def load(self, uid: str) -> ObjectAsset:
        """One starter object; nothing is computed, only unpacked."""
        entry, slug = self._entry(uid), _slug(uid)
        read = self._read(uid)
        return ObjectAsset(
            uid=uid,
            name=entry["name"],
            source=entry["source"],
            licence=entry["licence"],
            author=entry["author"],
            url=entry["url"],
            mesh=read.mesh,
            watertight=watertight_from_bytes(self._archive.read(f"{slug}.npz")),
            catalogue_scale=entry["catalogue_scale"],
            texture=TextureQuality(**entry["texture"]),
            T_obj_from_file=read.T_obj_from_file,
        )

    def describe(self, uid: str) -> ObjectDescription:
        """From the pack's index."""
        return ObjectDescription(licence=self._entry(uid)["licence"])

    def measure(self, uid: str) -> MeshMeasures:
        """The texture is that of the pack's index."""
        texture = TextureQuality(**self._entry(uid)["texture"])
        return replace(measure_mesh(self._read(uid).mesh), texture=texture)

    def notes(self) -> tuple[str, ...]:
        """None: the pack is complete."""
        return ()

    def _read(self, uid: str) -> ReadObject:
        slug = _slug(uid)
        file_mesh = read_gltf(Path(f"{slug}.glb"), self._archive.read(f"{slug}.glb"))
        return object_mesh(file_mesh, Path(uid), REFERENCE_READING, unit="m", up_axis="y")

    def _entry(self, uid: str) -> dict[str, Any]:
        if uid not in self._entries:
            raise unknown_object("starter pack", uid)
        return self._entries[uid]


def _slug(uid: str) -> str:
    return uid.partition("/")[2]


# Furniture is beyond a hand even as a miniature; and these are fixtures, not things one picks up.
LARGEST_SIDE_M = 0.40
FIXTURES = (
    "plug", "switch", "socket", "intercom", "cctv", "smoke", "bill", "entry", "emergency",
    "ceiling", "surveillance", "spotlight", "wall light", "light", "desk lamp",
)  # fmt: skip


class Sweethome3D:
    """Household models of Debian's sweethome3d-furniture, installed or unpacked below `root`.

    uid "sweethome3d/<library>/<model>". Objects larger than a hand holds are miniatures
    (`holdable_scale`).
    """

    def __init__(self, root: Path | None, preparation: PreparationConfig, cache_dir: Path) -> None:
        self._preparation, self._cache_dir = preparation, cache_dir.expanduser()
        self._entries: dict[str, tuple[Path, CatalogueEntry]] = {}
        for library in find_libraries(root):
            for entry in read_catalogue(library):
                if _is_household(entry):
                    self._entries[f"sweethome3d/{entry.library}/{entry.slug}"] = (library, entry)

    def uids(self) -> tuple[str, ...]:
        """Every model up to 40 cm that is no fixture, by library and catalogue order."""
        return tuple(self._entries)

    def load(self, uid: str) -> ObjectAsset:
        """Read, repair and prepare one model; watertight meshes come from the cache the second time."""
        _, entry = self._entry(uid)
        read, factor, mesh = self._read(uid)
        return ObjectAsset(
            uid=uid,
            name=entry.name,
            source=f"sweethome3d-furniture/{entry.library}",
            licence=entry.licence,
            author=entry.creator,
            url="https://www.sweethome3d.com/importModels.jsp",
            mesh=mesh,
            watertight=cached_watertight(mesh, self._preparation, self._cache_dir, source=uid),
            catalogue_scale=factor,
            texture=measure_texture_quality(mesh),
            T_obj_from_file=np.diag([factor, factor, factor, 1.0]) @ read.T_obj_from_file,
        )

    def describe(self, uid: str) -> ObjectDescription:
        """From the catalogue."""
        return ObjectDescription(licence=self._entry(uid)[1].licence)

    def measure(self, uid: str) -> MeshMeasures:
        """Of the mesh that `load` would draw, without making the watertight mesh."""
        read, _, mesh = self._read(uid)
        return measure_mesh(mesh, notes=read.notes)

    def notes(self) -> tuple[str, ...]:
        """None: what is no household model is left out by rule."""
        return ()

    def _entry(self, uid: str) -> tuple[Path, CatalogueEntry]:
        if uid not in self._entries:
            raise unknown_object("sweethome3d", uid)
        return self._entries[uid]

    def _read(self, uid: str) -> tuple[ReadObject, float, ObjectMesh]:
        """The file, its scale, and the drawn mesh at that scale."""
        file_mesh = read_model(*self._entry(uid))
        read = object_mesh(file_mesh, Path(uid), REFERENCE_READING, unit="m", up_axis="y")
        factor = holdable_scale(np.ptp(read.mesh.verts_obj, axis=0))
        return read, factor, outward_mesh(scaled_mesh(read.mesh, factor))


def _is_household(entry: CatalogueEntry) -> bool:
    is_fixture = any(word in entry.name.lower() for word in FIXTURES)
    return max(entry.size_m) <= LARGEST_SIDE_M and not is_fixture
