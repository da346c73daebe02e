"""Objaverse 1.0 as its own package `objaverse` stores it on disk. Nothing is downloaded here.

    <root>/glbs/000-xxx/<uid>.glb        the models; "<uid>.glb.tmp" while one is being downloaded
    <root>/metadata/000-xxx.json.gz      Sketchfab's record of each uid of that folder
    <root>/object-paths.json.gz          uid -> "glbs/000-xxx/<uid>.glb", of all 798,759
    <root>/lvis-annotations.json.gz      LVIS category -> uids

Source: github.com/allenai/objaverse-xl, objaverse/__init__.py. All but the models may be absent.
"""

import gzip
import json
import os
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from datagen.objects.asset.object_asset import ObjectAsset
from datagen.objects.catalogue.description import ObjectDescription
from datagen.objects.catalogue.licences import UNKNOWN_LICENCE
from datagen.objects.catalogue.objaverse_annotation import ObjaverseAnnotation, annotation_of_record
from datagen.objects.errors import ObjectError
from datagen.objects.formats.reading import ReadingConfig, ReadObject, read_object
from datagen.objects.mesh.graspable_size import fitted_scale, scaled_mesh
from datagen.objects.mesh.mesh_measures import MeshMeasures, measure_mesh
from datagen.objects.mesh.object_mesh import ObjectMesh
from datagen.objects.mesh.outward_faces import outward_mesh
from datagen.objects.mesh.texture_quality import measure_texture_quality
from datagen.objects.watertight.preparation import PreparationConfig, cached_watertight

__all__ = ["ObjaverseAnnotation", "ObjaverseStore", "objaverse_root"]

DEFAULT_ROOT = Path("~/.objaverse/hf-objaverse-v1")
ROOT_VARIABLE = "OBJAVERSE"
DOWNLOAD = "Download with `objaverse.load_objects(uids)` of the Python package objaverse"


class ObjaverseStore:
    """The models on disk; uid "objaverse/<Objaverse uid>".

    Sizes in Objaverse mean nothing. Each model is scaled until its bbox is as large as one hand
    holds (`fitted_scale`: smallest side up to 7.5 cm, as in GraspXL's "large" set);
    `catalogue_scale` records the factor.

    The folders are listed only when that is needed: by `uids`, and for a model that is not where
    object-paths.json.gz says.
    """

    def __init__(
        self, root: Path | None, reading: ReadingConfig, preparation: PreparationConfig, cache_dir: Path
    ) -> None:
        self._root, self._origin = _opened_root(root)
        self._reading, self._preparation = reading, preparation
        self._cache_dir = cache_dir.expanduser()
        if next(_walk(self._root), None) is None:
            raise ObjectError(
                self._root / "glbs",
                f"holds no models (chosen by {self._origin})",
                expected="000-xxx/<uid>.glb",
                action=f"{DOWNLOAD}.",
            )
        self._listing: dict[str, str] | None = None  # folder by uid, of the models on disk
        # By folder and uid, read when first asked for; the error where a record is malformed.
        self._notes: dict[str, dict[str, ObjaverseAnnotation | ObjectError]] = {}
        self._paths: dict[str, str] | None = None  # folder by uid, on disk or not
        self._categories: dict[str, str] | None = None

    @property
    def root(self) -> Path:
        """The folder in use, holding `glbs`."""
        return self._root

    def uids(self) -> tuple[str, ...]:
        """ "objaverse/<uid>" of every model on disk, sorted."""
        return tuple(f"objaverse/{uid}" for uid in self._listed())

    def walk(self) -> Iterator[str]:
        """The same uids in the order of the disk, each found when it is asked for."""
        return (f"objaverse/{uid}" for uid, _ in _walk(self._root))

    def holds(self, uid: str) -> bool:
        """Whether the model is on disk completely."""
        return self._folder_on_disk(_plain(uid)) is not None

    def glb_path(self, uid: str) -> Path:
        """The model's file. ObjectError where it is absent or only partly downloaded."""
        plain = _plain(uid)
        found = self._folder_on_disk(plain)
        if found is not None:
            return self._root / "glbs" / found / f"{plain}.glb"
        if any((folder / f"{plain}.glb.tmp").is_file() for folder in (self._root / "glbs").iterdir()):
            raise ObjectError(
                self._root,
                f"object {uid!r} is only partly downloaded ({plain}.glb.tmp)",
                expected=f"{plain}.glb",
                action=f"{DOWNLOAD} again.",
            )
        known = ": it is not downloaded" if self._folder_of_path(plain) else ""
        raise ObjectError(
            self._root,
            f"has no object {uid!r}{known} (folder chosen by {self._origin})",
            expected="one of its uids()",
            action=f"{DOWNLOAD}, or pick another uid.",
        )

    def load(self, uid: str) -> ObjectAsset:
        """Read, scale, repair and prepare one model; watertight meshes come from the cache the second time."""
        path = self.glb_path(uid)
        read, factor, mesh = self._read(path)
        note = self.annotation(uid)
        return ObjectAsset(
            uid=f"objaverse/{_plain(uid)}",
            name=(note and note.name) or _plain(uid),
            source="objaverse",
            licence=note.licence if note else UNKNOWN_LICENCE,
            author=(note and note.author) or "unknown",
            url=(note and note.url) or "",
            mesh=mesh,
            watertight=cached_watertight(mesh, self._preparation, self._cache_dir, source=path),
            catalogue_scale=factor,
            texture=measure_texture_quality(mesh),
            T_obj_from_file=np.diag([factor, factor, factor, 1.0]) @ read.T_obj_from_file,
        )

    def describe(self, uid: str) -> ObjectDescription:
        """Licence and annotation, without reading the model."""
        self.glb_path(uid)  # names what is not there
        note = self.annotation(uid)
        return ObjectDescription(licence=note.licence if note else UNKNOWN_LICENCE, annotation=note)

    def measure(self, uid: str) -> MeshMeasures:
        """Of the mesh that `load` would draw, without making the watertight mesh."""
        read, _, mesh = self._read(self.glb_path(uid))
        return measure_mesh(mesh, notes=read.notes)

    def notes(self) -> tuple[str, ...]:
        """None: a store is used as it is."""
        return ()

    def _read(self, path: Path) -> tuple[ReadObject, float, ObjectMesh]:
        """The file, its scale, and the drawn mesh at that scale."""
        read = read_object(path, self._reading)
        factor = fitted_scale(np.ptp(read.mesh.verts_obj, axis=0))
        return read, factor, outward_mesh(scaled_mesh(read.mesh, factor))

    def annotation(self, uid: str) -> ObjaverseAnnotation | None:
        """The metadata of one model, on disk or not; None where they are not on disk.

        Files are read once per instance. ObjectError where one is damaged, or this model's record.
        """
        plain = _plain(uid)
        folder = self._folder_of_path(plain) or self._folder_on_disk(plain)
        if folder is None:
            return None
        if folder not in self._notes:
            self._notes[folder] = self._notes_of(folder)
        note = self._notes[folder].get(plain)
        if isinstance(note, ObjectError):
            raise note.with_traceback(None)
        return note

    def _notes_of(self, folder: str) -> dict[str, ObjaverseAnnotation | ObjectError]:
        """Of every record of one folder: a record itself is ten times as large as its annotation."""
        path = self._root / "metadata" / f"{folder}.json.gz"
        if self._categories is None:
            self._categories = _categories(self._root / "lvis-annotations.json.gz")
        notes: dict[str, ObjaverseAnnotation | ObjectError] = {}
        for uid, record in _gzipped_json(path).items():
            if record is None:
                continue
            try:
                notes[uid] = annotation_of_record(record, self._categories.get(uid), source=path, uid=uid)
            except ObjectError as error:
                notes[uid] = error.with_traceback(None)  # whose frames would keep the records
        return notes

    def _listed(self) -> dict[str, str]:
        if self._listing is None:
            self._listing = dict(sorted(_walk(self._root)))
        return self._listing

    def _folder_on_disk(self, plain: str) -> str | None:
        """The folder that holds the whole model."""
        if self._listing is None:
            folder = self._folder_of_path(plain)
            if folder is not None and (self._root / "glbs" / folder / f"{plain}.glb").is_file():
                return folder
        return self._listed().get(plain)

    def _folder_of_path(self, plain: str) -> str | None:
        if self._paths is None:
            self._paths = _folders_of_paths(self._root / "object-paths.json.gz")
        return self._paths.get(plain)


def _plain(uid: str) -> str:
    return uid.removeprefix("objaverse/")


def objaverse_root(root: Path | None) -> Path:
    """The folder that is looked at: `root`, else $OBJAVERSE, else the default; it need not exist."""
    return _chosen_root(root)[0]


def _chosen_root(root: Path | None) -> tuple[Path, str]:
    """The store's folder, and what chose it."""
    if root is not None:
        chosen, origin = root, "the path in the configuration"
    elif os.environ.get(ROOT_VARIABLE):
        chosen, origin = Path(os.environ[ROOT_VARIABLE]), f"${ROOT_VARIABLE}"
    else:
        chosen, origin = DEFAULT_ROOT, f"the default, as ${ROOT_VARIABLE} is not set"
    chosen = chosen.expanduser()
    # ~/.objaverse itself is understood too.
    return (chosen / DEFAULT_ROOT.name if (chosen / DEFAULT_ROOT.name).is_dir() else chosen), origin


def _opened_root(root: Path | None) -> tuple[Path, str]:
    """The folder that holds `glbs`, and what chose it. ObjectError where there is none."""
    chosen, origin = _chosen_root(root)
    if (chosen / "glbs").is_dir():
        return chosen, origin
    raise ObjectError(
        chosen,
        f"{'holds no folder `glbs`' if chosen.is_dir() else 'is not a folder'} (chosen by {origin})",
        expected="the store of the Python package objaverse, usually ~/.objaverse/hf-objaverse-v1",
        action=f"{DOWNLOAD}, or set the path or ${ROOT_VARIABLE}.",
    )


def _walk(root: Path) -> Iterator[tuple[str, str]]:
    """Uid and folder of every completely downloaded model, in the order of the disk."""
    for folder in os.scandir(root / "glbs"):
        if folder.is_dir():
            for entry in os.scandir(folder):
                if entry.name.endswith(".glb") and not entry.name.startswith(".") and entry.is_file():
                    yield entry.name.removesuffix(".glb"), folder.name


def _folders_of_paths(path: Path) -> dict[str, str]:
    """Folder of every model of object-paths.json.gz, by uid; one string for all models of a folder."""
    found = {}
    for uid, place in _gzipped_json(path).items():
        if not isinstance(place, str):
            raise _damaged(path, f"has {place!r:.60} for {uid}", "glbs/000-xxx/<uid>.glb")
        found[uid] = sys.intern(place.rpartition("/")[0].rpartition("/")[2])
    return found


def _categories(path: Path) -> dict[str, str]:
    """LVIS category by uid; empty where the file is absent."""
    found: dict[str, str] = {}
    for category, uids in _gzipped_json(path).items():
        if not isinstance(uids, list) or not all(isinstance(uid, str) for uid in uids):
            raise _damaged(path, f"has {uids!r:.60} for {category!r}", "a list of uids")
        found |= dict.fromkeys(uids, category)
    return found


def _damaged(path: Path, problem: str, expected: str) -> ObjectError:
    return ObjectError(
        path,
        problem,
        expected=expected,
        action="Delete the file and download it again with the Python package objaverse.",
    )


def _gzipped_json(path: Path) -> dict[str, Any]:
    """A mapping; empty where the file is absent. ObjectError where it is damaged."""
    if not path.is_file():
        return {}
    try:
        content = json.loads(gzip.decompress(path.read_bytes()))
    except (OSError, EOFError, ValueError, RecursionError, zlib.error) as error:
        problem = f"cannot be unpacked ({type(error).__name__}: {error})"
        raise _damaged(path, problem, "gzipped JSON, as Objaverse publishes it") from error
    if not isinstance(content, dict):
        raise _damaged(path, f"holds a {type(content).__name__}", "a mapping, as Objaverse publishes it")
    return content
