"""The materials of an OBJ file with their images, which lie beside the MTL file or the OBJ."""

import io
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from datagen.objects.errors import ObjectError
from datagen.objects.files.named_files import NamedFiles
from datagen.objects.files.texture_images import MAX_IMAGE_PX, TEXTURE_FORMATS
from datagen.objects.mesh.object_mesh import ImageLayout, Material
from datagen.objects.wavefront.lines import shown
from datagen.objects.wavefront.mtl_file import RGB, MtlEntry, MtlMap
from datagen.objects.wavefront.mtl_libraries import MtlLibraries
from datagen.objects.wavefront.mtl_material import PLAIN_KD, material_from_mtl

__all__ = ["ObjMaterial", "ObjMaterials"]

GREY = (0.6, 0.6, 0.6)  # where no file tells of a material
SHOWN = ("map_kd", "map_ke", "norm")
BUMPS = ("map_bump", "bump")  # heights by the specification, normals by what Blender exports
WHITE = (1.0, 1.0, 1.0)
CLAMPED = ImageLayout(wrap_u="clamp", wrap_v="clamp")


@dataclass(frozen=True, kw_only=True)
class ObjMaterial:
    """A material, and where its images lie: they are looked up at uv * scale + offset."""

    material: Material
    plain_rgb: RGB  # display colour of vertices without one, where others have one
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)


class ObjMaterials:
    """Makes the materials of one OBJ file. `notes` tells what was guessed or left out."""

    def __init__(
        self, path: Path, files: NamedFiles, libraries: MtlLibraries, *, ignore_missing_images: bool
    ) -> None:
        self._path, self._files, self._libraries = path, files, libraries
        self._ignore_missing_images = ignore_missing_images
        self._images: dict[Path, bytes] = {}
        self._notes: list[str] = []
        self._unknown: list[str] = []
        self._left_out: Counter[str] = Counter()

    @property
    def notes(self) -> tuple[str, ...]:
        """A line each, in the order of what they tell of."""
        notes = [*self._libraries.notes, *self._notes]
        if self._unknown:
            listed = ", ".join(map(shown, self._unknown[:3])) + (" ..." if len(self._unknown) > 3 else "")
            notes.append(
                f"no MTL file tells of {len(self._unknown)} materials ({listed}); they are drawn grey"
            )
        if self._left_out:
            listed = ", ".join(f"{key} of {count} materials" for key, count in self._left_out.items())
            notes.append(f"images left out: {listed}")
        return tuple(dict.fromkeys(notes))

    def unnamed(self, *, is_colored: bool) -> ObjMaterial:
        """What faces without a material look like; white where vertices bring the colour."""
        return self._grey("unnamed", is_colored=is_colored)

    def named(self, name: str, *, is_colored: bool) -> ObjMaterial:
        """The material that `usemtl name` means. ObjectError where it or its image is missing.

        Where vertices bring colours (`is_colored`), a Kd that is absent, or that exporters write
        where nobody chose a colour, is white.
        """
        found = self._libraries.find(name)
        if found is None:
            self._unknown.append(name)
            return self._grey(name, is_colored=is_colored)
        entry = found.entry
        self._notes += entry.notes
        images = self._images_of(entry, (found.path.parent, self._path.parent))
        placed = [entry.maps[key] for key in entry.maps if key in images]
        kd = entry.kd or PLAIN_KD
        whitened = is_colored and kd == PLAIN_KD
        if len({(image.scale, image.offset) for image in placed}) > 1:
            self._notes.append(
                f"material {shown(name)}: all its images are placed as {shown(placed[0].name)}"
            )
        material = material_from_mtl(replace(entry, kd=WHITE) if whitened else entry, images)
        return ObjMaterial(
            material=_with_borders(material, entry.maps),
            plain_rgb=kd if whitened else WHITE,
            scale=placed[0].scale if placed else (1.0, 1.0),
            offset=placed[0].offset if placed else (0.0, 0.0),
        )

    def _grey(self, name: str, *, is_colored: bool) -> ObjMaterial:
        entry = MtlEntry(name=name, kd=WHITE if is_colored else GREY)
        return ObjMaterial(material=material_from_mtl(entry, {}), plain_rgb=GREY if is_colored else WHITE)

    def _images_of(self, entry: MtlEntry, folders: tuple[Path, Path]) -> dict[str, bytes]:
        """The images that are drawn, by the keyword of their line; a bump map that holds normals is "norm"."""
        images = {}
        for key, image in entry.maps.items():
            if key in SHOWN:
                data = self._image(image, folders)
                if data is not None:
                    images[key] = data
            elif key in BUMPS and "norm" not in entry.maps:
                found = self._files.find(image.names, folders)
                data = None if found is None else self._read(found.path)
                if data is not None and _shows_normals(data):
                    images["norm"] = data
                else:
                    self._left_out[key] += 1
            elif key != "map_ka" or "map_kd" not in entry.maps:  # ambient light shows map_Kd again
                self._left_out[key] += 1
        return images

    def _image(self, image: MtlMap, folders: tuple[Path, Path]) -> bytes | None:
        found = self._files.find(image.names, folders)
        if found is not None:
            if found.guessed:
                self._notes.append(
                    f"texture {shown(image.name)} is read from {found.path.name!r} beside the OBJ"
                )
            return self._read(found.path)
        if self._ignore_missing_images:
            self._notes.append(f"texture {shown(image.name)} is missing")
            return None
        raise ObjectError(
            self._path,
            f"texture {shown(image.name)} is missing",
            expected=f"an image of that name in {self._path.parent} or below (elsewhere nothing is opened)",
            action="Put the image there or remove its map_ line from the MTL file.",
        )

    def _read(self, path: Path) -> bytes:
        if path not in self._images:
            self._images[path] = self._files.read(path)
        return self._images[path]


def _with_borders(material: Material, maps: Mapping[str, MtlMap]) -> Material:
    """Images that are clamped show the colours of their borders beyond them; the others repeat."""
    layouts = {key: CLAMPED if image.clamps else ImageLayout() for key, image in maps.items()}
    normals = next((layouts[key] for key in ("norm", *BUMPS) if key in layouts), ImageLayout())
    return replace(
        material,
        base_color_layout=layouts.get("map_kd", ImageLayout()),
        emissive_layout=layouts.get("map_ke", ImageLayout()),
        normal_layout=normals,
    )


def _shows_normals(image: bytes) -> bool:
    """Whether an image is a map of tangent-space normals: its mean points out of the surface."""
    try:
        with Image.open(io.BytesIO(image), formats=TEXTURE_FORMATS) as opened:
            if opened.mode not in ("RGB", "RGBA") or max(opened.size) > MAX_IMAGE_PX:
                return False
            mean = np.asarray(opened.convert("RGB").resize((16, 16), Image.Resampling.BOX)).mean(axis=(0, 1))
    except Exception:  # Pillow raises whatever its decoders raise; what is no image shows nothing
        return False
    return bool((np.abs(mean[:2] - 127.5) < 40).all() and mean[2] > 180)
