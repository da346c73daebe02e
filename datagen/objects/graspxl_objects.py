"""The objects of GraspXL: rescaled, decimated, texture-free copies of Objaverse models.

    object_dataset/{small,medium,large}/<Objaverse uid>/<Objaverse uid>.obj

The files name neither unit nor axes; they are in the frame of the recorded poses: Z-up, metres
(github.com/zdchan/GraspXL, docs/DATASET.md; checked on the published examples). With an Objaverse
store the textured model is found again in the copy (`registration`) and drawn in its place.
"""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from datagen.objects.asset import ObjectAsset
from datagen.objects.description import ObjectDescription
from datagen.objects.errors import ObjectError
from datagen.objects.licences import UNKNOWN_LICENCE
from datagen.objects.mesh import ObjectMesh
from datagen.objects.objaverse import ObjaverseStore
from datagen.objects.orientation import outward_mesh
from datagen.objects.plain_look import with_plain_look
from datagen.objects.preparation import PreparationConfig, cached_solid
from datagen.objects.reading import ReadingConfig, ReadObject, read_object
from datagen.objects.registration import Registration, RegistrationConfig, register
from datagen.objects.texture_quality import TextureQuality, measure_texture_quality

__all__ = ["SIZES", "GraspXLObjects", "GraspXLTextures"]

SIZES = ("small", "medium", "large")
ROOT_VARIABLE = "GRASPXL"
LICENCE = "CC-BY-NC-4.0"
AUTHORS = "Zhang, Christen, Fan, Hilliges, Song (GraspXL, ECCV 2024)"
URL = "https://github.com/zdchan/GraspXL"

GraspXLTextures = Literal["none", "when_present", "required"]


@dataclass(frozen=True, kw_only=True)
class _Drawn:
    """What is drawn for one object, and whose work it is."""

    mesh: ObjectMesh
    name: str
    licence: str
    author: str
    url: str
    texture_source: ObjectMesh  # what texture quality is measured on: a generated look does not count
    registration: Registration | None


class GraspXLObjects:
    """The meshes of `object_dataset`; uid "objaverse/<Objaverse uid>@<small, medium or large>".

    `T_obj_from_file` is a shift: it leads from the frame of the recorded poses to ours. Solids have
    no convex parts, as recorded motions need no physics.

    `textures`: "none" draws a generated look; "when_present" draws the textured model where the
    store has it (one that does not match is refused, not replaced); "required" lists those alone.
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
        self._store = store if textures != "none" else None
        self._preparation, self._registration = preparation, registration
        self._cache_dir = cache_dir.expanduser()
        self._files = _mesh_files(_opened_root(root))
        if textures == "required" and store is not None:
            self._files = {uid: file for uid, file in self._files.items() if store.holds(file.stem)}
            if not self._files:
                raise ObjectError(
                    store.root,
                    "holds the textured model of none of the GraspXL objects",
                    expected="glbs/000-xxx/<uid>.glb for the uids of GraspXL",
                    action="Download them with `objaverse.load_objects(uids)`.",
                )

    def uids(self) -> tuple[str, ...]:
        """All objects at all sizes that are on disk, small to large, by uid."""
        return tuple(self._files)

    def load(self, uid: str) -> ObjectAsset:
        """Read, repair and prepare one mesh; solids come from the cache the second time."""
        file = self._file(uid)
        read = read_object(file, self._reading)
        drawn = self._drawn(read, file)
        return ObjectAsset(
            uid=uid,
            name=drawn.name,
            source="graspxl",
            licence=drawn.licence,
            author=drawn.author,
            url=drawn.url,
            mesh=drawn.mesh,
            solid=cached_solid(drawn.mesh, self._preparation, self._cache_dir, source=file, with_parts=False),
            catalogue_scale=1.0,  # of GraspXL's size; the model's own scale is in `registration`
            texture=measure_texture_quality(drawn.texture_source),
            T_obj_from_file=read.T_obj_from_file,
            registration=drawn.registration,
        )

    def describe(self, uid: str) -> ObjectDescription:
        """Licence of what will be drawn, with the annotation where that is the textured model."""
        file = self._file(uid)
        if self._store is not None and self._store.holds(file.stem):
            return self._store.describe(file.stem)
        return ObjectDescription(licence=LICENCE)

    def texture_quality(self, uid: str) -> TextureQuality:
        """As `load` measures it, without making the solid."""
        file = self._file(uid)
        drawn = self._drawn(read_object(file, self._reading), file)
        return measure_texture_quality(drawn.texture_source)

    def _file(self, uid: str) -> Path:
        if uid not in self._files:
            raise ObjectError(
                "GraspXL objects",
                f"there is no object {uid!r}",
                expected="one of its uids(), such as 'objaverse/<32 hex digits>@large'",
                action="List the uids and pick one.",
            )
        return self._files[uid]

    def _drawn(self, read: ReadObject, file: Path) -> _Drawn:
        if self._store is not None and self._store.holds(file.stem):
            return self._textured(read, file, self._store)
        return _untextured(read, file)

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
            name=(note and note.name) or file.stem,
            licence=note.licence if note else UNKNOWN_LICENCE,
            author=(note and note.author) or "unknown",
            url=(note and note.url) or "",
            texture_source=mesh,
            registration=found,
        )


def _untextured(read: ReadObject, file: Path) -> _Drawn:
    bare = outward_mesh(read.mesh)
    return _Drawn(
        mesh=with_plain_look(bare, file.stem),
        name=file.stem,
        licence=LICENCE,
        author=AUTHORS,
        url=URL,
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


def _mesh_files(root: Path) -> dict[str, Path]:
    files = {}
    for size in SIZES:
        if not (root / size).is_dir():
            continue
        for name in sorted(entry.name for entry in os.scandir(root / size) if entry.is_dir()):
            file = root / size / name / f"{name}.obj"
            if file.is_file():
                files[f"objaverse/{name}@{size}"] = file
    if not files:
        raise ObjectError(
            root,
            "holds no <id>/<id>.obj",
            expected="object_dataset/{small,medium,large}/<id>/<id>.obj",
            action="Point at object_dataset; the recorded motions are other archives.",
        )
    return files
