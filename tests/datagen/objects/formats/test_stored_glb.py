"""What is stored of any object is valid glTF: judged by the Khronos validator, and read back."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from datagen.objects.formats.glb_export import mesh_to_glb
from datagen.objects.formats.reading import ReadingConfig, object_mesh, read_object
from datagen.objects.gltf.scene import read_gltf
from datagen.objects.mesh.object_mesh import ImageLayout, Material, ObjectMesh
from datagen.objects.stores.library import REFERENCE_READING, StarterPack
from tests.datagen.objects.gltf_bytes import GltfBytes
from tests.datagen.objects.gltf_validator import khronos_findings

CONFIG = ReadingConfig(unit="m", up_axis="y", max_faces=5000, max_image_px=256)
PIXELS = np.random.default_rng(0).integers(0, 256, (8, 8, 3), dtype=np.uint8)


def saved(image: Image.Image, kind: str) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, format=kind)
    return buffer.getvalue()


IMAGES = {
    "bmp": saved(Image.fromarray(PIXELS), "BMP"),
    "webp": saved(Image.fromarray(PIXELS), "WEBP"),
    "gif": saved(Image.fromarray(PIXELS), "GIF"),
    "tiff": saved(Image.fromarray(PIXELS), "TIFF"),
    "tga": saved(Image.fromarray(PIXELS), "TGA"),
    "cmyk jpeg": saved(Image.fromarray(PIXELS).convert("CMYK"), "JPEG"),
    "grey jpeg": saved(Image.fromarray(PIXELS).convert("L"), "JPEG"),
    "16-bit png": saved(Image.fromarray(PIXELS[..., 0].astype(np.uint16) * 257), "PNG"),
    "palette png": saved(Image.fromarray(PIXELS).quantize(9), "PNG"),
}


def textured(folder: Path, image: bytes) -> ObjectMesh:
    """As a stranger's GLB with this image in every place reads."""
    made = GltfBytes()
    texture = {"index": made.texture(image)}
    pbr = {"baseColorTexture": texture, "metallicRoughnessTexture": texture}
    made.square(
        material=made.material(pbrMetallicRoughness=pbr, normalTexture=texture, emissiveTexture=texture)
    )
    (folder / "a.glb").write_bytes(made.glb())
    return read_object(folder / "a.glb", CONFIG).mesh


def everything(box: tuple[np.ndarray, np.ndarray]) -> ObjectMesh:
    """Every field in use: layers, wrap modes, corner colours on some faces, glass, strong emission."""
    rng = np.random.default_rng(0)
    image, layout = saved(Image.fromarray(PIXELS), "PNG"), ImageLayout(uv_layer=1, wrap_v="clamp")
    painted = Material(
        name="painted ä",
        base_color_rgba=(0.2, 0.4, 1.0, 0.5),
        base_color_image=image,
        metallic_roughness_image=image,
        normal_image=image,
        emissive_image=image,
        emissive_rgb=(3.0, 1.0, 0.0),
        base_color_layout=ImageLayout(wrap_u="mirror"),
        normal_layout=ImageLayout(uv_layer=2),
        emissive_layout=layout,
    )
    glass = Material(name="glass", base_color_rgba=(1.0, 1.0, 1.0, 1.0), transmission=1.0, ior=1.5)
    colors = rng.random((12, 3, 3))
    colors[6:] = 1.0
    return ObjectMesh(
        verts_obj=box[0],
        faces=box[1],
        corner_uv=rng.uniform(-2, 2, (12, 3, 2)),
        face_material=np.arange(12) % 2,
        materials=(painted, glass),
        corner_colors=colors,
        more_corner_uv=(rng.uniform(-2, 2, (12, 3, 2)), rng.uniform(-2, 2, (12, 3, 2))),
    )


def stored_meshes(folder: Path, box: tuple[np.ndarray, np.ndarray]) -> dict[str, ObjectMesh]:
    pack, full = StarterPack(), everything(box)
    return {
        **{f"texture {kind}": textured(folder, image) for kind, image in IMAGES.items()},
        **{uid: pack.load(uid).mesh for uid in pack.uids()[::6]},
        "everything": full,
        "flat": replace(full, smooth=False),
    }


def test_the_khronos_validator_finds_nothing(tmp_path, box):
    meshes = stored_meshes(tmp_path, box)
    files = [tmp_path / f"{index}.glb" for index in range(len(meshes))]
    for file, mesh in zip(files, meshes.values()):
        file.write_bytes(mesh_to_glb(mesh))
    found = dict(zip(meshes, khronos_findings(files)))
    assert found == {name: [] for name in meshes}


def test_stored_meshes_read_back_here_and_elsewhere(tmp_path, box):
    for name, mesh in stored_meshes(tmp_path, box).items():
        stored = mesh_to_glb(mesh)
        file_mesh = read_gltf(Path(name), stored)
        assert file_mesh.notes == ()
        back = object_mesh(file_mesh, Path(name), REFERENCE_READING, unit="m", up_axis="y").mesh
        assert mesh_to_glb(replace(back, smooth=mesh.smooth))[:12] == stored[:12], name  # of the same length
        assert [m.base_color_image for m in back.materials] == [m.base_color_image for m in mesh.materials]
        elsewhere = trimesh.load_scene(io.BytesIO(stored), file_type="glb", process=False)
        assert sum(len(part.faces) for part in elsewhere.geometry.values()) == len(mesh.faces)


def test_what_is_stored_reads_back_whole(box):
    mesh = everything(box)
    file_mesh = read_gltf(Path("a.glb"), mesh_to_glb(mesh))
    back = object_mesh(file_mesh, Path("a.glb"), CONFIG, unit="m", up_axis="y").mesh
    order = np.argsort(mesh.face_material, kind="stable")
    assert [replace(m, emissive_rgb=(0.0, 0.0, 0.0)) for m in back.materials] == [
        replace(m, emissive_rgb=(0.0, 0.0, 0.0)) for m in mesh.materials
    ]
    np.testing.assert_allclose(back.materials[0].emissive_rgb, (3, 1, 0), rtol=1e-6)
    np.testing.assert_allclose(back.corner_uv, mesh.corner_uv[order], atol=1e-6)
    assert back.corner_colors is not None
    assert mesh.corner_colors is not None
    np.testing.assert_allclose(back.corner_colors, mesh.corner_colors[order], atol=1e-7)
    painted = back.face_material == 0
    for ours, theirs in zip(mesh.more_corner_uv, back.more_corner_uv, strict=True):
        np.testing.assert_allclose(theirs[painted], ours[order][painted], atol=1e-6)


@pytest.mark.parametrize("kind", IMAGES)
def test_only_png_and_jpeg_are_stored(tmp_path, kind):
    mesh = textured(tmp_path, IMAGES[kind])
    stored, image = mesh_to_glb(mesh), mesh.materials[0].base_color_image
    assert image is not None
    mime = b"image/png" if Image.open(io.BytesIO(image)).format == "PNG" else b"image/jpeg"
    assert mime in stored
    assert stored.count(image) == 1
