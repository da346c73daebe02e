"""Packed, quantised and otherwise extended glTF reads as its plain twin."""

import io
import json
import struct
from pathlib import Path
from typing import Any

import DracoPy
import numpy as np
import pytest
from PIL import Image

from datagen.objects.errors import ObjectError
from datagen.objects.formats.glb_export import mesh_to_glb
from datagen.objects.formats.reading import ReadingConfig, read_object
from datagen.objects.gltf.container import open_gltf
from datagen.objects.stores.library import StarterPack

CONFIG = ReadingConfig(unit="m", up_axis="y", max_faces=50_000, max_image_px=4096)
BITS = 14


def glb_bytes(document: dict, binary: bytes) -> bytes:
    text = json.dumps({"asset": {"version": "2.0"}, **document}).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def png(pixels) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.asarray(pixels, dtype=np.uint8)).save(buffer, format="PNG")
    return buffer.getvalue()


def packed_twin(plain: bytes) -> bytes:
    """The GLB with its primitives Draco-compressed; images move to the front of the buffer."""
    file = open_gltf(Path("plain.glb"), plain)
    document, binary, views = file.json, b"", []

    def view(data: bytes) -> int:
        nonlocal binary
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)})
        binary += data + b"\0" * (-len(data) % 4)
        return len(views) - 1

    accessors: list[dict[str, Any]] = []
    for k in range(len(document.get("images", []))):
        data = file.image(k)
        document["images"][k]["bufferView"] = view(data)
    for primitive in document["meshes"][0]["primitives"]:
        attributes = primitive["attributes"]
        positions, uv = file.accessor(attributes["POSITION"]), file.accessor(attributes["TEXCOORD_0"])
        faces = file.accessor(primitive["indices"]).reshape(-1, 3)
        # Positions quantised to 14 bits; coordinates as a generic attribute with an id of our choice.
        data = DracoPy.encode(
            positions, faces.astype(np.uint32), quantization_bits=BITS, generic_attributes={7: uv}
        )
        position_id = next(
            a["unique_id"] for a in DracoPy.decode(data).attributes if a["attribute_type"] == 0
        )
        primitive["attributes"] = {"POSITION": len(accessors), "TEXCOORD_0": len(accessors) + 1}
        primitive["indices"] = len(accessors) + 2
        accessors += [
            {"componentType": 5126, "count": len(positions), "type": "VEC3"},
            {"componentType": 5126, "count": len(uv), "type": "VEC2"},
            {"componentType": 5125, "count": faces.size, "type": "SCALAR"},
        ]
        primitive["extensions"] = {
            "KHR_draco_mesh_compression": {
                "bufferView": view(data),
                "attributes": {"POSITION": position_id, "TEXCOORD_0": 7},
            }
        }
    document |= {"accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(binary)}]}
    document["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    return glb_bytes(document, binary)


@pytest.mark.parametrize("name", ["bread", "stone_lantern", "lantern"])
def test_draco_file_reads_as_its_plain_twin(tmp_path, name):
    plain_file, packed_file = tmp_path / "plain.glb", tmp_path / "packed.glb"
    plain_file.write_bytes(mesh_to_glb(StarterPack().load(f"starter/{name}").mesh))
    packed_file.write_bytes(packed_twin(plain_file.read_bytes()))
    plain, packed = (read_object(path, CONFIG).mesh for path in (plain_file, packed_file))
    step = np.ptp(plain.verts_obj, axis=0).max() / 2**BITS
    assert packed.materials == plain.materials
    # Quantisation may weld a sliver away; every face that is left has its twin.
    assert len(plain.faces) - 0.002 * len(plain.faces) <= len(packed.faces) <= len(plain.faces)
    centers = [mesh.verts_obj[mesh.faces].mean(axis=1) for mesh in (plain, packed)]
    uvs = [mesh.corner_uv.mean(axis=1) for mesh in (plain, packed)]
    for center, uv in zip(centers[1][::7], uvs[1][::7]):
        near = np.flatnonzero(np.abs(centers[0] - center).max(axis=1) <= 2 * step)
        assert len(near), "a face without a twin"
        assert np.abs(uvs[0][near] - uv).max(axis=1).min() < 1e-5


def test_draco_colours_are_normalised_as_the_accessor_says(tmp_path):
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=np.float32)
    colors = np.array([[255, 0, 0, 255]] * 3, dtype=np.uint8)
    data = DracoPy.encode(points, np.array([[0, 1, 2]], dtype=np.uint32), colors=colors)
    ids = {a["attribute_type"]: a["unique_id"] for a in DracoPy.decode(data).attributes}
    document: dict[str, Any] = {
        "nodes": [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0, "COLOR_0": 1},
                        "extensions": {
                            "KHR_draco_mesh_compression": {
                                "bufferView": 0,
                                "attributes": {"POSITION": ids[0], "COLOR_0": ids[2]},
                            }
                        },
                    }
                ]
            }
        ],
        "accessors": [
            {"componentType": 5126, "count": 3, "type": "VEC3"},
            {"componentType": 5121, "count": 3, "type": "VEC4", "normalized": True},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": len(data)}],
        "buffers": [{"byteLength": len(data)}],
    }
    (tmp_path / "a.glb").write_bytes(glb_bytes(document, data))
    mesh = read_object(tmp_path / "a.glb", CONFIG).mesh
    assert mesh.corner_colors is not None
    np.testing.assert_array_equal(mesh.corner_colors, [[[1, 0, 0]] * 3])
    document["meshes"][0]["primitives"][0]["extensions"]["KHR_draco_mesh_compression"]["attributes"][
        "COLOR_0"
    ] = 99
    (tmp_path / "b.glb").write_bytes(glb_bytes(document, data))
    with pytest.raises(ObjectError, match=r"has no attribute 99 \(COLOR_0\)"):
        read_object(tmp_path / "b.glb", CONFIG)
    (tmp_path / "c.glb").write_bytes(glb_bytes(document, b"\1" * len(data)))
    with pytest.raises(ObjectError, match="Draco data of bufferView 0 cannot be decoded"):
        read_object(tmp_path / "c.glb", CONFIG)


POSITIONS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype="<f4").tobytes()


def triangle(binary: bytes = POSITIONS, **more) -> bytes:
    document = {
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "material": 0}]}],
        "materials": [{}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": len(binary)}],
    }
    return glb_bytes({**document, **more}, binary)


def test_quantised_mesh_reads_as_its_plain_twin(tmp_path):
    """KHR_mesh_quantization: 16-bit positions (padded rows) scaled by the node, normalised UVs."""
    positions = np.array([[0, 0, 0, 0], [32767, 0, 0, 0], [0, 16384, 0, 0]], dtype="<i2")
    uv = np.array([[0, 0], [65535, 0], [0, 65535]], dtype="<u2")
    binary = positions.tobytes() + uv.tobytes()
    (tmp_path / "q.glb").write_bytes(
        triangle(
            binary,
            nodes=[{"mesh": 0, "scale": [0.2, 0.2, 0.2]}],
            meshes=[{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}}]}],
            accessors=[
                {"bufferView": 0, "componentType": 5122, "count": 3, "type": "VEC3", "normalized": True},
                {"bufferView": 1, "componentType": 5123, "count": 3, "type": "VEC2", "normalized": True},
            ],
            bufferViews=[
                {"buffer": 0, "byteLength": 24, "byteStride": 8},
                {"buffer": 0, "byteOffset": 24, "byteLength": 12},
            ],
            extensionsRequired=["KHR_mesh_quantization"],
        )
    )
    mesh = read_object(tmp_path / "q.glb", CONFIG).mesh
    np.testing.assert_allclose(np.ptp(mesh.verts_obj, axis=0), [0.2, 0, 0.2 * 16384 / 32767])
    np.testing.assert_allclose(sorted(mesh.corner_uv.reshape(-1, 2).tolist()), [[0, 0], [0, 1], [1, 1]])


def gloss_material(tmp_path, images=(), **look):
    """The material that a specular-gloss triangle is read with."""
    binary, views = POSITIONS, [{"buffer": 0, "byteLength": 36}]
    for image in images:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(image)})
        binary += image
    (tmp_path / "g.glb").write_bytes(
        triangle(
            binary,
            materials=[{"extensions": {"KHR_materials_pbrSpecularGlossiness": look}}],
            bufferViews=views,
            images=[{"bufferView": k + 1} for k in range(len(images))],
            textures=[{"source": k} for k in range(len(images))],
            extensionsRequired=["KHR_materials_pbrSpecularGlossiness"],
        )
    )
    return read_object(tmp_path / "g.glb", CONFIG).mesh.materials[0]


def test_specular_gloss_of_gold_is_a_metal(tmp_path):
    """The example of the extension's specification."""
    gold = gloss_material(
        tmp_path, diffuseFactor=[0, 0, 0, 1], specularFactor=[1.0, 0.766, 0.336], glossinessFactor=0.9
    )
    assert gold.metallic == pytest.approx(1.0)
    assert gold.roughness == pytest.approx(0.1)
    np.testing.assert_allclose(gold.base_color_rgba, [1.0, 0.766, 0.336, 1.0], atol=1e-6)


def test_specular_gloss_of_paint_keeps_its_image(tmp_path):
    image = png(np.full((4, 4, 3), (200, 30, 30)))
    paint = gloss_material(
        tmp_path,
        [image],
        diffuseTexture={"index": 0},
        diffuseFactor=[1, 1, 1, 0.5],
        specularFactor=[0.04, 0.04, 0.04],
        glossinessFactor=0.3,
    )
    assert paint.base_color_image == image
    assert paint.base_color_rgba == (1, 1, 1, 0.5)
    assert (paint.metallic, paint.roughness) == (0, pytest.approx(0.7))


def test_metallic_roughness_survives_the_way_there_and_back(tmp_path):
    """Forward equations of both models against the conversion."""
    base, metallic = np.array([0.5, 0.3, 0.2]), 0.6
    specular = 0.04 * (1 - metallic) + metallic * base
    diffuse = base * (1 - metallic) * 0.96 / (1 - specular.max())
    read = gloss_material(
        tmp_path, diffuseFactor=[*diffuse, 1.0], specularFactor=list(specular), glossinessFactor=0.5
    )
    assert read.metallic == pytest.approx(metallic, abs=0.05)
    np.testing.assert_allclose(read.base_color_rgba[:3], base, atol=0.05)


def test_specular_gloss_image_tells_metal_from_paint(tmp_path):
    diffuse = png([[(200, 60, 60), (0, 0, 0)]])
    gloss = png([[(56, 56, 56, 51), (250, 200, 120, 204)]])  # paint, then metal
    read = gloss_material(
        tmp_path, [diffuse, gloss], diffuseTexture={"index": 0}, specularGlossinessTexture={"index": 1}
    )
    surface = np.asarray(Image.open(io.BytesIO(read.metallic_roughness_image)))[0]
    color = np.asarray(Image.open(io.BytesIO(read.base_color_image)))[0]
    np.testing.assert_array_equal(surface[:, 1], [204, 51])  # 1 - glossiness
    assert surface[0, 2] < 20
    assert surface[1, 2] > 250
    np.testing.assert_allclose(color, [(200, 60, 60), (250, 200, 120)], atol=4)
    assert (read.metallic, read.roughness) == (1, 1)


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "basisu": (
        {
            "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
            "textures": [{"extensions": {"KHR_texture_basisu": {"source": 0}}}],
        },
        "texture 0 exists as KHR_texture_basisu only",
    ),
    "no image": (
        {"materials": [{"normalTexture": {"index": 0}}], "textures": [{}]},
        "texture 0 exists as no image at all",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_what_would_be_drawn_wrongly_is_refused(tmp_path, case):
    more, message = BAD[case]
    (tmp_path / "a.glb").write_bytes(triangle(**more))
    with pytest.raises(ObjectError, match=message) as caught:
        read_object(tmp_path / "a.glb", CONFIG)
    assert "\n" not in str(caught.value)


def test_unlit_is_drawn_matt(tmp_path):
    (tmp_path / "a.glb").write_bytes(
        triangle(
            materials=[{"extensions": {"KHR_materials_unlit": {}}}],
            extensionsRequired=["KHR_materials_unlit"],
        )
    )
    material = read_object(tmp_path / "a.glb", CONFIG).mesh.materials[0]
    assert (material.metallic, material.roughness) == (0, 0.9)


def test_large_files_are_refused_before_they_are_read(tmp_path):
    small = ReadingConfig(unit="m", up_axis="y", max_faces=9, max_image_px=64, max_file_mb=0.001)
    (tmp_path / "a.glb").write_bytes(b"x" * 2000)
    with pytest.raises(ObjectError, match=r"has 0 MB; expected at most 0\.001 MB"):
        read_object(tmp_path / "a.glb", small)
    (tmp_path / "b.bin").write_bytes(b"x" * 2000)
    (tmp_path / "b.gltf").write_text(
        '{"asset": {"version": "2.0"}, "buffers": [{"uri": "b.bin", "byteLength": 4}]}'
    )
    with pytest.raises(ObjectError, match=r"its buffer 'b\.bin' has 0 MB"):
        read_object(tmp_path / "b.gltf", small)
