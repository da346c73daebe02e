"""Furniture libraries of Sweet Home 3D (`.sh3f`): zips of OBJ models with a catalogue."""

import re
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float

from datagen.objects.errors import ObjectError
from datagen.objects.gltf.container import MAX_FILE_MB
from datagen.objects.mesh.file_mesh import FileMesh
from datagen.objects.wavefront.obj_file import read_obj

__all__ = ["CatalogueEntry", "find_libraries", "read_catalogue", "read_model"]

INSTALLED = Path("/usr/share/sweethome3d/furniture")
# One licence per library, from the LICENSE.TXT inside each and the Debian copyright file.
LICENCES = {
    "BlendSwap-CC-0": "CC0-1.0",
    "BlendSwap-CC-BY": "CC-BY-3.0",
    "KatorLegaz": "CC-BY-3.0-US",
    "Reallusion": "CC-BY-3.0-US",
    "Scopia": "CC-BY-3.0",
}


@dataclass(frozen=True, kw_only=True)
class CatalogueEntry:
    """One model of a library's catalogue."""

    library: str
    index: int
    name: str
    creator: str
    licence: str  # SPDX id
    model: str  # path of the OBJ inside the zip
    size_m: tuple[float, float, float]  # width (x), depth (y), height (z), after the rotation
    rotation: Float[np.ndarray, "3 3"]  # Y-up axes of the file, x_shown = rotation @ x_file

    @property
    def slug(self) -> str:
        """Name of the model's folder, unique in its library."""
        return Path(self.model).parent.name


def find_libraries(root: Path | None) -> tuple[Path, ...]:
    """The `.sh3f` files below `root` (unpacked package) or of the installed package."""
    folder = INSTALLED if root is None else root
    found = sorted(folder.rglob("*.sh3f")) if folder.is_dir() else []
    if not found:
        raise ObjectError(
            folder,
            "holds no Sweet Home 3D library",
            expected="*.sh3f files",
            action="Install it (`apt-get install sweethome3d-furniture`) or unpack it "
            "(`apt-get download sweethome3d-furniture && dpkg-deb -x *.deb DIR`) and give DIR.",
        )
    return tuple(found)


def _properties(text: str) -> dict[int, dict[str, str]]:
    """Java properties `key#index=value`, grouped by index."""
    groups: dict[int, dict[str, str]] = {}
    for line in text.splitlines():
        match = re.match(r"^(\w+)#(\d+)=(.*)$", line)
        if match:
            value = re.sub(r"\\u([0-9a-fA-F]{4})", lambda m: chr(int(m[1], 16)), match[3])
            groups.setdefault(int(match[2]), {})[match[1]] = value.strip()
    return groups


def read_catalogue(library: Path) -> tuple[CatalogueEntry, ...]:
    """All models of one library that state a size, in catalogue order."""
    try:
        with zipfile.ZipFile(library) as archive:
            text = archive.read("PluginFurnitureCatalog.properties").decode("latin-1")
    except (zipfile.BadZipFile, KeyError) as error:
        raise ObjectError(
            library,
            f"is not a furniture library ({error})",
            expected="a zip with PluginFurnitureCatalog.properties",
            action="Install the package again.",
        ) from error
    entries = []
    for index, item in sorted(_properties(text).items()):
        if not {"model", "width", "depth", "height"} <= item.keys():
            continue
        numbers = [float(word) for word in item.get("modelRotation", "1 0 0 0 1 0 0 0 1").split()]
        entries.append(
            CatalogueEntry(
                library=library.stem,
                index=index,
                name=item.get("name", Path(item["model"]).stem),
                creator=item.get("creator", "unknown"),
                licence=LICENCES.get(library.stem, "NOASSERTION"),
                model=item["model"].lstrip("/"),
                size_m=(float(item["width"]) / 100, float(item["depth"]) / 100, float(item["height"]) / 100),
                rotation=np.array(numbers).reshape(3, 3),
            )
        )
    return tuple(entries)


def read_model(library: Path, entry: CatalogueEntry) -> FileMesh:
    """The model turned and scaled to its catalogue size. Axes Y-up, metres, as glTF."""
    with TemporaryDirectory() as folder:
        prefix = str(Path(entry.model).parent) + "/"
        with zipfile.ZipFile(library) as archive:
            for name in archive.namelist():
                if name.startswith(prefix) and not name.endswith("/"):
                    target = Path(folder, name)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    target.write_bytes(archive.read(name))
        # A few published models name images that were never part of them; Sweet Home 3D
        # shows those materials in their plain colour.
        file_mesh = read_obj(Path(folder, entry.model), max_file_mb=MAX_FILE_MB, ignore_missing_images=True)
    verts = file_mesh.verts_file @ entry.rotation.T
    used = verts[np.unique(file_mesh.faces)]
    extent = np.ptp(used, axis=0)
    width, depth, height = entry.size_m
    target_m = np.array([width, height, depth])  # Y-up: y is height, z is depth
    scale = np.divide(target_m, extent, out=np.ones(3), where=extent > 0)
    return replace(file_mesh, verts_file=verts * scale)
