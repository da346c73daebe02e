"""The objects of GraspXL: rescaled, decimated, texture-free copies of Objaverse models.

    object_dataset/{small,medium,large}/<Objaverse uid>/<Objaverse uid>.obj

The files name neither unit nor axes; they are in the frame of the recorded poses: Z-up, metres
(github.com/zdchan/GraspXL, docs/DATASET.md; checked on the published examples). With an Objaverse
store the textured model is found again in the copy (`registration`) and drawn in its place.
"""

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from datagen.objects.asset.object_asset import ObjectAsset
from datagen.objects.catalogue.description import Appearance, ObjectDescription
from datagen.objects.catalogue.licences import UNKNOWN_LICENCE, joined_licences
from datagen.objects.errors import ObjectError
from datagen.objects.formats.reading import ReadingConfig, ReadObject, read_object
from datagen.objects.mesh.mesh_measures import MeshMeasures, measure_mesh
from datagen.objects.mesh.object_mesh import ObjectMesh
from datagen.objects.mesh.outward_faces import outward_mesh
from datagen.objects.mesh.plain_look import with_plain_look
from datagen.objects.mesh.registration import Registration, RegistrationConfig, register
from datagen.objects.mesh.texture_quality import measure_texture_quality
from datagen.objects.stores.objaverse import ObjaverseAnnotation, ObjaverseStore
from datagen.objects.watertight.preparation import PreparationConfig, cached_watertight

__all__ = ["SIZES", "GraspXLObjects", "GraspXLTextures"]

SIZES = ("small", "medium", "large")
UID = re.compile(rf"objaverse/([^/\\@]+)@({'|'.join(SIZES)})")
ROOT_VARIABLE = "GRASPXL"
LICENCE = "CC-BY-NC-4.0"
AUTHORS = "Zhang, Christen, Fan, Hilliges, Song (GraspXL, ECCV 2024)"
URL = "https://github.com/zdchan/GraspXL"

GraspXLTextures = Literal["none", "when_present", "required"]


@dataclass(frozen=True, kw_only=True)
class _Drawn:
    """What is drawn for one object, and whose work it is."""

    mesh: ObjectMesh
    source: str
    appearance: Appearance
    name: str
    licence: str
    author: str
    url: str
    texture_source: ObjectMesh  # what texture quality is measured on: a generated look does not count
    registration: Registration | None


class GraspXLObjects:
    """The meshes of `object_dataset`; uid "objaverse/<Objaverse uid>@<small, medium or large>".

    `T_obj_from_file` is a shift: it leads from the frame of the recorded poses to ours. Watertight meshes have
    no convex parts, as recorded motions need no physics.

    `textures`: "none" draws a generated look; "when_present" draws the textured model where the
    store has it (one that does not match is refused, not replaced); "required" refuses objects
    whose model the store has not.

    A bare mesh derives from the Objaverse model. With a store, in any mode, its licence is GraspXL's
    and the model's, and the model's author is named; without one, GraspXL's alone is known.
    """

    def __init__(
        self,
        root: Path | None,
        store: ObjaverseStore | None,
        *,
        textures: GraspXLTextures,
        reading: ReadingConfig,
        preparation: PreparationConfig,
        registration: RegistrationConfig,
        cache_dir: Path,
    ) -> None:
        if textures == "required" and store is None:
            raise ObjectError(
                "GraspXL objects",
                "textures are required but there is no Objaverse store",
                expected="a store to take the textured models from",
                action="Set its path, or choose textures `when_present` or `none`.",
            )
        # Never "auto": a 3 m thing in these files would be 3 m.
        self._reading = replace(reading, unit="m", up_axis="z")
        self._store, self._textures = store, textures
        self._preparation, self._registration = preparation, registration
        self._cache_dir = cache_dir.expanduser()
        self._root = _opened_root(root)
        self._uids: tuple[str, ...] | None = None
        # One of each is enough: there may be 250,000 meshes.
        if not any(name for size in SIZES for name in _mesh_names(self._root, size)):
            raise ObjectError(
                self._root,
                "holds no <id>/<id>.obj",
                expected="object_dataset/{small,medium,large}/<id>/<id>.obj",
                action="Point at object_dataset; the recorded motions are other archives.",
            )
        if textures == "required" and store is not None and not self._any_model(store):
            raise ObjectError(
                store.root,
                "holds the textured model of none of the GraspXL objects",
                expected="glbs/000-xxx/<uid>.glb for the uids of GraspXL",
                action="Download them with `objaverse.load_objects(uids)`.",
            )

    def uids(self) -> tuple[str, ...]:
        """All objects at all sizes that are on disk, small to large, by uid; listed once."""
        if self._uids is None:
            self._uids = tuple(
                f"objaverse/{name}@{size}" for size in SIZES for name in sorted(_mesh_names(self._root, size))
            )
        return self._uids

    def load(self, uid: str) -> ObjectAsset:
        """Read, repair and prepare one mesh; watertight meshes come from the cache the second time."""
        file = self._file(uid)
        read = read_object(file, self._reading)
        drawn = self._drawn(read, file)
        return ObjectAsset(
            uid=uid,
            name=drawn.name,
            source=drawn.source,
            licence=drawn.licence,
            author=drawn.author,
            url=drawn.url,
            mesh=drawn.mesh,
            watertight=cached_watertight(
                drawn.mesh, self._preparation, self._cache_dir, source=file, with_parts=False
            ),
            catalogue_scale=1.0,  # of GraspXL's size; the model's own scale is in `registration`
            texture=measure_texture_quality(drawn.texture_source),
            T_obj_from_file=read.T_obj_from_file,
            registration=drawn.registration,
            appearance=drawn.appearance,
        )

    def describe(self, uid: str) -> ObjectDescription:
        """Licence of what will be drawn, and the annotation of the model where a store has it."""
        file = self._file(uid)
        store = self._store_to_draw(file)
        if store is not None:
            return store.describe(file.stem)
        note = self._note(file)
        return ObjectDescription(licence=_bare_licence(note), annotation=note, appearance="generated")

    def measure(self, uid: str) -> MeshMeasures:
        """Of the mesh that `load` would draw, without making the watertight mesh."""
        file = self._file(uid)
        read = read_object(file, self._reading)
        return measure_mesh(self._drawn(read, file).texture_source, notes=read.notes)

    def notes(self) -> tuple[str, ...]:
        """None: the folders are used as they are."""
        return ()

    def _file(self, uid: str) -> Path:
        parts = UID.fullmatch(uid)
        file = None if parts is None else self._mesh_file(parts[1], parts[2])
        if file is None or not file.is_file():
            raise ObjectError(
                "GraspXL objects",
                f"there is no object {uid!r}",
                expected="one of its uids(), such as 'objaverse/<32 hex digits>@large'",
                action="List the uids and pick one.",
            )
        return file

    def _mesh_file(self, name: str, size: str) -> Path:
        return self._root / size / name / f"{name}.obj"

    def _any_model(self, store: ObjaverseStore) -> bool:
        """Whether the store holds the model of any object here."""
        names = (uid.partition("/")[2] for uid in store.walk())
        return any(self._mesh_file(name, size).is_file() for name in names for size in SIZES)

    def _store_to_draw(self, file: Path) -> ObjaverseStore | None:
        """The store whose model is drawn for this mesh; None: the mesh itself."""
        store = self._store
        if store is None or self._textures == "none":
            return None
        # Required: the store itself says what is not there, or only in part.
        return store if self._textures == "required" or store.holds(file.stem) else None

    def _note(self, file: Path) -> ObjaverseAnnotation | None:
        return None if self._store is None else self._store.annotation(file.stem)

    def _drawn(self, read: ReadObject, file: Path) -> _Drawn:
        store = self._store_to_draw(file)
        return (
            _untextured(read, file, self._note(file)) if store is None else self._textured(read, file, store)
        )

    def _textured(self, read: ReadObject, file: Path, store: ObjaverseStore) -> _Drawn:
        """The Objaverse model, moved to where the copy is."""
        glb = store.glb_path(file.stem)
        original = read_object(glb, self._reading).mesh
        found = register(
            original.verts_obj,
            original.faces,
            read.mesh.verts_obj,
            read.mesh.faces,
            self._registration,
            source=glb,
        )
        T = found.T_rescaled_from_original
        mesh = outward_mesh(replace(original, verts_obj=original.verts_obj @ T[:3, :3].T + T[:3, 3]))
        note = store.annotation(file.stem)
        return _Drawn(
            mesh=mesh,
            source="objaverse",
            appearance="original",
            name=(note and note.name) or file.stem,
            licence=note.licence if note else UNKNOWN_LICENCE,
            author=(note and note.author) or "unknown",
            url=(note and note.url) or "",
            texture_source=mesh,
            registration=found,
        )


def _bare_licence(note: ObjaverseAnnotation | None) -> str:
    """Of GraspXL's mesh: a work derived from the annotated model."""
    return LICENCE if note is None else joined_licences(LICENCE, note.licence)


def _untextured(read: ReadObject, file: Path, note: ObjaverseAnnotation | None) -> _Drawn:
    bare = outward_mesh(read.mesh)
    return _Drawn(
        mesh=with_plain_look(bare, file.stem),
        source="graspxl",
        appearance="generated",
        name=(note and note.name) or file.stem,
        licence=_bare_licence(note),
        author=AUTHORS if note is None else f"{note.author or 'unknown'}; mesh: {AUTHORS}",
        url=(note and note.url) or URL,
        texture_source=bare,
        registration=None,
    )


def _opened_root(root: Path | None) -> Path:
    """The folder that holds small, medium or large, where unzipping may have put it."""
    chosen = root
    if chosen is None and os.environ.get(ROOT_VARIABLE):
        chosen = Path(os.environ[ROOT_VARIABLE])
    if chosen is None:
        raise ObjectError(
            "GraspXL objects",
            f"neither a path nor ${ROOT_VARIABLE} is set",
            expected="the folder that holds object_dataset",
            action=f"Ask for the data at {URL}, unzip object_dataset.zip and set the path.",
        )
    chosen = chosen.expanduser()
    for base in (chosen, chosen / "dataset_example"):
        for folder in (base, base / "object_dataset", base / "object_dataset" / "object_dataset"):
            if any((folder / size).is_dir() for size in SIZES):
                return folder
    raise ObjectError(
        chosen,
        "holds no GraspXL objects" if chosen.is_dir() else "is not a folder",
        expected="object_dataset/{small,medium,large}/<id>/<id>.obj",
        action="Unzip object_dataset.zip there; the recorded motions are other archives.",
    )


def _mesh_names(root: Path, size: str) -> Iterator[str]:
    """Ids of the meshes of one size, in the order of the disk."""
    if (root / size).is_dir():
        for entry in os.scandir(root / size):
            if (root / size / entry.name / f"{entry.name}.obj").is_file():
                yield entry.name
