"""Object libraries: the starter pack in this package, a folder of meshes, Sweet Home 3D."""

import csv
import io
import json
import zipfile
from importlib.resources import files
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from datagen.objects.asset.object_asset import ObjectAsset
from datagen.objects.catalogue.description import ObjectDescription
from datagen.objects.catalogue.licences import UNKNOWN_LICENCE, joined_licences, licence_parts, spdx_of
from datagen.objects.errors import ObjectError
from datagen.objects.formats.reading import MESH_SUFFIXES, ReadingConfig, ReadObject, object_mesh, read_object
from datagen.objects.gltf.scene import read_gltf
from datagen.objects.mesh.graspable_size import holdable_scale, refuse_unheld_size, scaled_mesh
from datagen.objects.mesh.object_mesh import ObjectMesh
from datagen.objects.mesh.outward_faces import outward_mesh
from datagen.objects.mesh.texture_quality import TextureQuality, measure_texture_quality
from datagen.objects.stores.sweethome3d import CatalogueEntry, find_libraries, read_catalogue, read_model
from datagen.objects.watertight.preparation import PreparationConfig, cached_watertight, watertight_from_bytes

__all__ = ["REFERENCE_READING", "MeshFolder", "ObjectLibrary", "StarterPack", "Sweethome3D"]

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

    def texture_quality(self, uid: str) -> TextureQuality:
        """The `texture` that `load` would give, without its costly parts."""


def _unknown(where: object, uid: str) -> ObjectError:
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
        entry = self._entry(uid)
        slug = uid.partition("/")[2]
        file_mesh = read_gltf(Path(f"{slug}.glb"), self._archive.read(f"{slug}.glb"))
        read = object_mesh(file_mesh, Path(uid), REFERENCE_READING, unit="m", up_axis="y")
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

    def texture_quality(self, uid: str) -> TextureQuality:
        """From the pack's index."""
        return TextureQuality(**self._entry(uid)["texture"])

    def _entry(self, uid: str) -> dict[str, Any]:
        if uid not in self._entries:
            raise _unknown("starter pack", uid)
        return self._entries[uid]


class MeshFolder:
    """Every GLB, GLTF, OBJ, PLY and STL below a folder; uid "folder/<relative path>".

    A file `objects.csv` in the folder may tell more: columns path, name, licence (as `spdx_of`
    takes it), author, url. What it does not tell is "NOASSERTION".
    """

    def __init__(
        self, path: Path, reading: ReadingConfig, preparation: PreparationConfig, cache_dir: Path
    ) -> None:
        if not path.is_dir():
            raise ObjectError(
                path, "is not a folder", expected="a folder of meshes", action="Check the path."
            )
        self._path, self._reading = path, reading
        self._preparation, self._cache_dir = preparation, cache_dir.expanduser()
        self._files = {
            f"folder/{file.relative_to(path).as_posix()}": file
            for file in sorted(path.rglob("*"))
            if file.suffix.lower() in MESH_SUFFIXES and file.is_file()
        }
        if not self._files:
            raise ObjectError(
                path,
                "holds no meshes",
                expected=f"files ending in {', '.join(MESH_SUFFIXES)}",
                action="Check the path.",
            )
        self._notes = _folder_notes(path / "objects.csv")

    def uids(self) -> tuple[str, ...]:
        """ "folder/<relative path>" of every mesh file, sorted."""
        return tuple(self._files)

    def load(self, uid: str) -> ObjectAsset:
        """Read, repair and prepare one mesh; watertight meshes come from the cache the second time."""
        file, note = self._file(uid), self._note(uid)
        read = self._read(file)
        mesh = outward_mesh(read.mesh)
        return ObjectAsset(
            uid=uid,
            name=note.get("name") or file.stem,
            source="folder",
            licence=self.describe(uid).licence,
            author=note.get("author") or "unknown",
            url=note.get("url") or "",
            mesh=mesh,
            watertight=cached_watertight(mesh, self._preparation, self._cache_dir, source=file),
            catalogue_scale=1.0,
            texture=measure_texture_quality(mesh),
            T_obj_from_file=read.T_obj_from_file,
        )

    def describe(self, uid: str) -> ObjectDescription:
        """From `objects.csv`."""
        self._file(uid)  # names what is not there
        return ObjectDescription(licence=self._note(uid).get("licence") or UNKNOWN_LICENCE)

    def texture_quality(self, uid: str) -> TextureQuality:
        """As `load` measures it, without making the watertight mesh."""
        return measure_texture_quality(outward_mesh(self._read(self._file(uid)).mesh))

    def _read(self, file: Path) -> ReadObject:
        """As the file is, which is the size that will be held."""
        read = read_object(file, self._reading)
        refuse_unheld_size(read.mesh, file)
        return read

    def _file(self, uid: str) -> Path:
        if uid not in self._files:
            raise _unknown(self._path, uid)
        return self._files[uid]

    def _note(self, uid: str) -> dict[str, str]:
        return self._notes.get(uid.partition("/")[2], {})


def _folder_notes(path: Path) -> dict[str, dict[str, str]]:
    if not path.is_file():
        return {}
    with path.open(encoding="utf-8", newline="") as handle:
        rows = list(csv.DictReader(handle))
    if rows and "path" not in rows[0]:
        raise ObjectError(
            path,
            "has no column 'path'",
            expected="columns path, name, licence, author, url",
            action="Add the header line.",
        )
    return {
        row["path"]: {**row, "licence": _licence_of_row(path, number, row)}
        for number, row in enumerate(rows, start=2)  # the header is row 1
    }


def _licence_of_row(path: Path, number: int, row: dict[str, str]) -> str:
    """SPDX id (or several joined by AND); empty where the row does not tell."""
    written = (row.get("licence") or "").strip()
    try:
        return joined_licences(*map(spdx_of, licence_parts(written))) if written else ""
    except ObjectError as error:
        raise ObjectError(
            path,
            f"row {number} ({row['path']}): the licence {written!r} is not known",
            expected=error.expected,
            action=error.action,
        ) from error


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

    def texture_quality(self, uid: str) -> TextureQuality:
        """As `load` measures it, without making the watertight mesh."""
        return measure_texture_quality(self._read(uid)[2])

    def _entry(self, uid: str) -> tuple[Path, CatalogueEntry]:
        if uid not in self._entries:
            raise _unknown("sweethome3d", uid)
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
