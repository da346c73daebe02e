"""MeshFolder: the objects of a folder that a user hands in."""

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

from datagen.objects.asset.object_asset import ObjectAsset
from datagen.objects.catalogue.description import ObjectDescription
from datagen.objects.catalogue.folder_layouts import drawn_uid, layout_rank, object_uid_of_file
from datagen.objects.catalogue.licences import UNKNOWN_LICENCE
from datagen.objects.catalogue.objects_table import TABLE_NAME, ObjectRow, read_objects_table
from datagen.objects.errors import ObjectError
from datagen.objects.formats.colored_files import tells_colors
from datagen.objects.formats.reading import MESH_SUFFIXES, ReadingConfig, ReadObject, read_object
from datagen.objects.mesh.graspable_size import refuse_unheld_size
from datagen.objects.mesh.mesh_measures import MeshMeasures, measure_mesh
from datagen.objects.mesh.outward_faces import outward_mesh
from datagen.objects.mesh.texture_quality import measure_texture_quality
from datagen.objects.stores.folder_files import FolderFiles, FoundFile, find_files, pointed_to
from datagen.objects.stores.folder_rows import rows_of_objects
from datagen.objects.stores.library import unknown_object
from datagen.objects.watertight.preparation import PreparationConfig, cached_watertight

__all__ = ["MeshFolder", "folder_state"]

_SHOWN = 8  # objects of several files that are named one by one


class MeshFolder:
    """Every object in the GLB, GLTF, OBJ, PLY and STL files below a folder.

    uid "folder/<path of the file without suffix>". Files that are one object by their names
    (`folder_layouts`) have one uid; the one with colours is drawn, of several the first by
    `layout_rank` that can be read. "folder/<a>@<b>" (`variant_of`) is object b under the identity of a.

    A table `objects.csv` in the folder may tell more (`read_objects_table`). What it does not tell
    is "NOASSERTION".
    """

    def __init__(
        self, path: Path, reading: ReadingConfig, preparation: PreparationConfig, cache_dir: Path
    ) -> None:
        found = _opened(path)
        self._path, self._reading = path, reading
        self._preparation, self._cache_dir = preparation, cache_dir.expanduser()
        meshes = [file for file in found.files if file.path.suffix.lower() in MESH_SUFFIXES]
        if not meshes:
            raise ObjectError(
                path,
                "; ".join(("holds no meshes", *_listing_notes(found))),
                expected=f"files ending in {', '.join(MESH_SUFFIXES)}",
                action="Check the path.",
            )
        self._files = _grouped(path, meshes)
        table = _table_path(path, found)
        self._rows: dict[str, ObjectRow] = {}
        row_notes: tuple[str, ...] = ()
        if table is not None:
            places = {uid: [file.place for file in files] for uid, files in self._files.items()}
            self._rows, row_notes = rows_of_objects(read_objects_table(table), table, places)
        self._notes = (*_listing_notes(found), *row_notes, *_joined_notes(self._files))

    def uids(self) -> tuple[str, ...]:
        """Of every object, sorted."""
        return tuple(self._files)

    def notes(self) -> tuple[str, ...]:
        """What was left out, guessed or joined when the folder was opened."""
        return self._notes

    def load(self, uid: str) -> ObjectAsset:
        """Read, repair and prepare one object; watertight meshes come from the cache the second time."""
        read, file, _ = self._read(uid)
        row = self._rows.get(self._plain(uid))
        mesh = outward_mesh(read.mesh)
        return ObjectAsset(
            uid=uid,
            name=(row and row.name) or file.stem,
            source="folder",
            licence=self.describe(uid).licence,
            author=(row and row.author) or "unknown",
            url=(row and row.url) or "",
            mesh=mesh,
            watertight=cached_watertight(mesh, self._preparation, self._cache_dir, source=file),
            catalogue_scale=1.0,
            texture=measure_texture_quality(mesh),
            T_obj_from_file=read.T_obj_from_file,
        )

    def describe(self, uid: str) -> ObjectDescription:
        """From `objects.csv`."""
        row = self._rows.get(self._plain(uid))
        return ObjectDescription(licence=(row and row.licence) or UNKNOWN_LICENCE)

    def measure(self, uid: str) -> MeshMeasures:
        """Of the mesh that `load` would draw, without making the watertight mesh."""
        read, _, notes = self._read(uid)
        return measure_mesh(outward_mesh(read.mesh), notes=(*read.notes, *notes))

    def _plain(self, uid: str) -> str:
        """The object that is drawn, without the identity it was given. ObjectError where there is none."""
        plain = drawn_uid(uid)
        if plain not in self._files:
            raise unknown_object(self._path, uid)
        return plain

    def _read(self, uid: str) -> tuple[ReadObject, Path, tuple[str, ...]]:
        """The first file of the object that can be read, and a note on those before it."""
        faults: list[ObjectError] = []
        for file in self._files[self._plain(uid)]:
            try:
                return (
                    _read_file(file, self._reading),
                    file.path,
                    tuple(f"not drawn: {fault}" for fault in faults),
                )
            except ObjectError as error:
                faults.append(error)
        raise faults[0]


def folder_state(path: Path) -> str:
    """Changes when a file in the folder comes, goes or changes."""
    digest = hashlib.sha256()
    for file in find_files(path).files:
        known = f" {file.size} {file.modified_ns} {file.fault}\n"
        digest.update(os.fsencode(file.place) + known.encode("utf-8", "backslashreplace"))
    return digest.hexdigest()


def _opened(path: Path) -> FolderFiles:
    if not os.path.isdir(path):
        raise ObjectError(path, "is not a folder", expected="a folder of meshes", action="Check the path.")
    return find_files(path)


def _read_file(file: FoundFile, config: ReadingConfig) -> ReadObject:
    pointer = "" if file.fault else pointed_to(file.path)
    if file.fault or pointer:
        raise ObjectError(
            file.path,
            file.fault or f"holds {pointer}, not the mesh",
            expected="a mesh file that can be read",
            action="Copy or download the file itself, or delete it here.",
        )
    try:
        read = read_object(file.path, config)
        refuse_unheld_size(read.mesh, file.path)
        return read
    except OSError as error:
        raise ObjectError(
            file.path,
            f"cannot be read ({error.strerror or error})",
            expected="a mesh file, and the files that it names",
            action="Check the disk and the permissions.",
        ) from error


def _grouped(root: Path, meshes: Sequence[FoundFile]) -> dict[str, list[FoundFile]]:
    """Files of each object by uid, the one to draw first."""
    name = root.resolve().name or "object"
    groups: dict[str, list[FoundFile]] = {}
    for file in meshes:
        groups.setdefault(object_uid_of_file(file.place, name), []).append(file)
    return {uid: _ranked(groups[uid]) for uid in sorted(groups)}


def _ranked(files: list[FoundFile]) -> list[FoundFile]:
    if len(files) == 1:
        return files
    return sorted(
        files, key=lambda file: (bool(file.fault), not tells_colors(file.path), layout_rank(file.place))
    )


def _table_path(root: Path, found: FolderFiles) -> Path | None:
    """objects.csv, in any case where only one file is called so."""
    named = [file.path for file in found.files if file.place.casefold() == TABLE_NAME]
    exact = [path for path in named if path.name == TABLE_NAME]
    if len(named) > 1 and not exact:
        raise ObjectError(
            root,
            f"holds {' and '.join(path.name for path in named)}",
            expected=f"one {TABLE_NAME}",
            action="Delete one of them.",
        )
    return next(iter(exact or named), None)


def _listing_notes(found: FolderFiles) -> tuple[str, ...]:
    notes = []
    hidden = [place for place in found.hidden if place.lower().endswith(MESH_SUFFIXES)]
    if hidden:
        notes.append(f"hidden files left out: {_counted(hidden)}")
    if found.unreadable:
        notes.append(f"folders that cannot be read: {_counted(found.unreadable)}")
    links = [file.place for file in found.files if "." not in file.path.name and pointed_to(file.path)]
    if links:
        notes.append(f"links that were unpacked as text and lead nowhere now: {_counted(links)}")
    return tuple(notes)


def _counted(names: Sequence[str]) -> str:
    return f"{len(names):,}, such as {names[0]}" if len(names) > 1 else names[0]


def _joined_notes(files: dict[str, list[FoundFile]]) -> tuple[str, ...]:
    """One line for each object of several files, and how many more there are."""
    joined = {uid: of_uid for uid, of_uid in files.items() if len(of_uid) > 1}
    notes = [
        f"one object by name: {uid}: {of_uid[0].place} is drawn, not "
        f"{', '.join(file.place for file in of_uid[1:4])}{' ...' if len(of_uid) > 4 else ''}"
        for uid, of_uid in list(joined.items())[:_SHOWN]
    ]
    if len(joined) > _SHOWN:
        n_files = sum(map(len, joined.values()))
        notes.append(f"one object by name: {len(joined):,} objects in all, in {n_files:,} files")
    return tuple(notes)
