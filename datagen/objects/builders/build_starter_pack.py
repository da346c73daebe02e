"""Build data/starter_pack.zip and data/ATTRIBUTION.md from Debian's sweethome3d-furniture.

    apt-get download sweethome3d-furniture
    python -m datagen.objects.builders.build_starter_pack sweethome3d-furniture_*.deb

The .deb, a folder it was unpacked to, or nothing (the installed package) will do. The same
package gives the same bytes.
"""

import argparse
import io
import json
import tarfile
import zipfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

from datagen.objects.asset.object_asset import WatertightMesh
from datagen.objects.builders.starter_selection import DROPPED, SELECTION, Look, Pick
from datagen.objects.formats.glb_export import mesh_to_glb
from datagen.objects.formats.reading import object_mesh
from datagen.objects.gltf.scene import read_gltf
from datagen.objects.mesh.decimation import decimated_mesh
from datagen.objects.mesh.graspable_size import holdable_scale
from datagen.objects.mesh.object_mesh import Material
from datagen.objects.mesh.outward_faces import outward_mesh
from datagen.objects.mesh.submeshes import mesh_pieces, sub_mesh
from datagen.objects.mesh.texture_quality import measure_texture_quality
from datagen.objects.stores.library import REFERENCE_READING
from datagen.objects.stores.sweethome3d import CatalogueEntry, find_libraries, read_catalogue, read_model
from datagen.objects.watertight.preparation import (
    REFERENCE_PREPARATION,
    cached_watertight,
    watertight_to_bytes,
)

LIBRARY = "BlendSwap-CC-0"
SOURCE = f"sweethome3d-furniture 1.8-1, {LIBRARY}.sh3f"
URL = "https://packages.debian.org/sid/sweethome3d-furniture"
MAX_IMAGE_PX = 1024
VERTEX_STEP_M = 2.0**-18  # 4 micrometres: invisible, and such numbers compress twice as well
UV_STEP = 2.0**-14


@dataclass(frozen=True, kw_only=True)
class Built:
    """One finished object."""

    slug: str
    glb: bytes
    watertight: WatertightMesh
    entry: dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("package", type=Path, nargs="?", help=".deb or unpacked folder; default: installed")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "data")
    parser.add_argument("--cache", type=Path, default=Path("~/.cache/forehoi/objects"))
    parser.add_argument("--only", nargs="*", help="build these slugs and print metrics; write no pack")
    arguments = parser.parse_args()
    with TemporaryDirectory() as folder:
        root = arguments.package
        if root is not None and root.suffix == ".deb":
            unpack_deb(root, Path(folder))
            root = Path(folder)
        library = next(path for path in find_libraries(root) if path.stem == LIBRARY)
        catalogue = {entry.slug: entry for entry in read_catalogue(library)}
        built = []
        for pick in sorted(SELECTION, key=lambda pick: pick.slug):
            if arguments.only and pick.slug not in arguments.only:
                continue
            built.append(build(pick, library, catalogue[pick.model], arguments.cache.expanduser()))
            print_metrics(built[-1])
    if not arguments.only:
        arguments.out.mkdir(parents=True, exist_ok=True)
        write_pack(built, arguments.out / "starter_pack.zip")
        (arguments.out / "ATTRIBUTION.md").write_text(attribution(built), encoding="utf-8")
        print(f"{len(built)} objects, {(arguments.out / 'starter_pack.zip').stat().st_size / 1e6:.2f} MB")


def unpack_deb(deb: Path, folder: Path) -> None:
    """The .sh3f files of a .deb: an `ar` archive with a data.tar inside."""
    data = deb.read_bytes()
    offset = 8
    while offset < len(data):
        name, size = data[offset : offset + 16].decode().strip(" /"), int(data[offset + 48 : offset + 58])
        if name.startswith("data.tar"):
            with tarfile.open(fileobj=io.BytesIO(data[offset + 60 : offset + 60 + size])) as archive:
                members = [member for member in archive if member.name.endswith(f"{LIBRARY}.sh3f")]
                archive.extractall(folder, members=members, filter="data")
            return
        offset += 60 + size + size % 2
    raise ValueError(f"{deb}: holds no data.tar; expected a Debian package")


def build(pick: Pick, library: Path, entry: CatalogueEntry, cache_dir: Path) -> Built:
    """Read, repair, shrink to a hand's size, lighten, and compute everything that is shipped."""
    file_mesh = read_model(library, entry)
    mesh = object_mesh(file_mesh, Path(pick.slug), REFERENCE_READING, unit="m", up_axis="y").mesh
    dropped = [k for k, material in enumerate(mesh.materials) if material.name in pick.without_materials]
    mesh = sub_mesh(mesh, ~np.isin(mesh.face_material, dropped))
    if pick.piece is not None:
        mesh = sub_mesh(mesh, mesh_pieces(mesh) == pick.piece)
    mesh = decimated_mesh(outward_mesh(mesh), pick.max_faces)
    factor = holdable_scale(np.ptp(mesh.verts_obj, axis=0))
    mesh = replace(
        mesh,
        verts_obj=np.round(mesh.verts_obj * factor / VERTEX_STEP_M) * VERTEX_STEP_M,
        corner_uv=np.round(mesh.corner_uv / UV_STEP) * UV_STEP,
        materials=tuple(shipped_material(m, pick.looks.get(m.name, Look())) for m in mesh.materials),
    )
    glb = mesh_to_glb(mesh, normals=False)
    # Everything derived comes from the mesh as users will load it.
    file_mesh = read_gltf(Path(pick.slug), glb)
    mesh = object_mesh(file_mesh, Path(pick.slug), REFERENCE_READING, unit="m", up_axis="y").mesh
    watertight = cached_watertight(mesh, REFERENCE_PREPARATION, cache_dir, source=pick.slug)
    return Built(
        slug=pick.slug,
        glb=glb,
        watertight=watertight,
        entry={
            "uid": f"starter/{pick.slug}",
            "name": pick.name,
            "source": f"{SOURCE}, {entry.name} (number {entry.index})",
            "licence": entry.licence,
            "author": entry.creator,
            "url": URL,
            "catalogue_scale": round(factor, 6),
            "size_m": [round(float(side), 4) for side in np.ptp(mesh.verts_obj, axis=0)],
            "texture": asdict(measure_texture_quality(mesh)),
        },
    )


def shipped_material(material: Material, look: Look) -> Material:
    """The material with its touched-up values and an image of moderate size."""
    color = material.base_color_rgba if look.color is None else (*look.color, 1.0)
    image = material.base_color_image if look.color is None else None
    return replace(
        material,
        base_color_rgba=(round(color[0], 4), round(color[1], 4), round(color[2], 4), round(color[3], 4)),
        base_color_image=None if image is None else shipped_image(image),
        roughness=round(material.roughness if look.roughness is None else look.roughness, 3),
        metallic=material.metallic if look.metallic is None else look.metallic,
        transmission=material.transmission if look.transmission is None else look.transmission,
    )


def shipped_image(image: bytes) -> bytes:
    """The file as it is where it is small; otherwise at most 1024 px, JPEG."""
    opened = Image.open(io.BytesIO(image), formats=("PNG", "JPEG"))
    if max(opened.size) <= MAX_IMAGE_PX:
        return image
    factor = MAX_IMAGE_PX / max(opened.size)
    size = (round(opened.width * factor), round(opened.height * factor))
    buffer = io.BytesIO()
    opened.convert("RGB").resize(size, Image.Resampling.LANCZOS).save(buffer, format="JPEG", quality=90)
    return buffer.getvalue()


def write_pack(built: list[Built], path: Path) -> None:
    """One zip with fixed dates; the .npz are compressed already."""
    index = json.dumps([item.entry for item in built], indent=1, ensure_ascii=False)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(zipfile.ZipInfo("index.json"), index, zipfile.ZIP_DEFLATED, 9)
        for item in built:
            archive.writestr(zipfile.ZipInfo(f"{item.slug}.glb"), item.glb, zipfile.ZIP_DEFLATED, 9)
            data = watertight_to_bytes(item.watertight)
            archive.writestr(zipfile.ZipInfo(f"{item.slug}.npz"), data, zipfile.ZIP_STORED)


def attribution(built: list[Built]) -> str:
    """ATTRIBUTION.md: who made what, and what was changed."""
    lines = [
        "# Starter pack: authors and licences",
        "",
        f"All models are CC0-1.0 (public domain), from the library {LIBRARY} of Debian's",
        f"sweethome3d-furniture 1.8-1 ({URL}); published on https://www.blendswap.com by the authors",
        "named, cleaned and converted to OBJ by Emmanuel Puybaret (eTeks). CC0 asks for no credit; the",
        "authors are named with thanks. Generated by `builders/build_starter_pack.py`; do not edit.",
        "",
        "Changed here: axes Z-up, repeated triangles removed, faces turned outward, lightened to at most",
        "8,000 triangles, scaled to what a hand holds (column scale), materials converted to",
        "metallic-roughness.",
        "",
        "| uid | name | author | licence | size (cm) | scale | source |",
        "|---|---|---|---|---|---|---|",
    ]
    for item in built:
        entry = item.entry
        size = " × ".join(f"{100 * side:.1f}" for side in entry["size_m"])
        lines.append(
            f"| {entry['uid']} | {entry['name']} | {entry['author']} | {entry['licence']} "
            f"| {size} | {entry['catalogue_scale']:.2f} | {entry['source']} |"
        )
    lines += ["", "Models of a suitable size that were left out:", ""]
    lines += [f"- {model}: {reason}" for model, reason in sorted(DROPPED.items())]
    return "\n".join(lines) + "\n"


def print_metrics(item: Built) -> None:
    fit, size = item.watertight.fit, [round(100 * side, 1) for side in item.entry["size_m"]]
    assert fit is not None
    print(
        f"{item.slug:16s} {size} cm x{item.entry['catalogue_scale']:.2f} glb {len(item.glb) // 1000} kB, solid "
        f"{len(item.watertight.faces)} faces{'' if item.watertight.watertight_source else ' (level set)'}, "
        f"{len(item.watertight.parts)} hulls | mm: deviation {1e3 * fit.deviation_mean_m:.2f} mean "
        f"{1e3 * fit.deviation_max_m:.2f} max, uncovered {1e3 * fit.uncovered_max_m:.2f}, hull excess "
        f"{1e3 * fit.hull_excess_p99_m:.2f} p99 {1e3 * fit.hull_excess_max_m:.2f} max, hull short "
        f"{1e3 * fit.hull_uncovered_max_m:.2f}",
        flush=True,
    )


if __name__ == "__main__":
    main()
