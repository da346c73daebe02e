"""What strangers' glTF files may hold: every fault one ObjectError, nothing read that is not theirs."""

import base64
import io
import json
import struct
from copy import deepcopy
from typing import Any

import numpy as np
import pytest
from PIL import Image

from datagen.objects.errors import ObjectError
from datagen.objects.formats.reading import ReadingConfig, read_object

CONFIG = ReadingConfig(unit="auto", up_axis="y", max_faces=5000, max_image_px=256)
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype="<f4").tobytes()
COORDINATES = np.array([[0, 0], [1, 0], [0, 1]], dtype="<f4").tobytes()


def png() -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (8, 8), (200, 30, 30)).save(buffer, format="PNG")
    return buffer.getvalue()


def in_data_uri(data: bytes) -> str:
    return "data:application/octet-stream;base64," + base64.b64encode(data).decode()


BINARY = CORNERS + COORDINATES
DOCUMENT = {
    "asset": {"version": "2.0"},
    "scenes": [{"nodes": [0]}],
    "nodes": [{"mesh": 0}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
    "accessors": [
        {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
        {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
    ],
    "bufferViews": [
        {"buffer": 0, "byteLength": len(CORNERS)},
        {"buffer": 0, "byteOffset": len(CORNERS), "byteLength": len(COORDINATES)},
    ],
    "buffers": [{"byteLength": len(BINARY)}],
    "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
    "textures": [{"source": 0}],
    "images": [{"uri": in_data_uri(png())}],
}


def glb_bytes(document: dict, binary: bytes = BINARY) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def changed(*steps, value) -> dict:
    """DOCUMENT with the value at `steps` replaced."""
    document = deepcopy(DOCUMENT)
    place: Any = document
    for step in steps[:-1]:
        place = place[step]
    place[steps[-1]] = value
    return document


def problem_of(path) -> str:
    with pytest.raises(ObjectError) as caught:
        read_object(path, CONFIG)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert "expected" in text
    assert "\n" not in text
    assert len(text) < 800
    return caught.value.problem


def glb_problem(folder, document: dict, binary: bytes = BINARY) -> str:
    path = folder / "a.glb"
    path.write_bytes(glb_bytes(document, binary))
    return problem_of(path)


def test_unchanged_file_is_sound(tmp_path):
    (tmp_path / "a.glb").write_bytes(glb_bytes(DOCUMENT))
    mesh = read_object(tmp_path / "a.glb", CONFIG).mesh
    np.testing.assert_allclose(np.ptp(mesh.verts_obj, axis=0), [1, 0, 1])
    assert mesh.materials[0].base_color_image == png()


POSITION, VIEW, COLOR = ("accessors", 0), ("bufferViews", 0), ("materials", 0, "pbrMetallicRoughness")
MALFORMED = {
    "matrix of 15": (("nodes", 0, "matrix"), [1] * 15),
    "rotation of 3": (("nodes", 0, "rotation"), [1, 0, 0]),
    "scale of 2": (("nodes", 0, "scale"), [1, 1]),
    "children null": (("nodes", 0, "children"), None),
    "mesh -1": (("nodes", 0, "mesh"), -1),
    "node -1": (("scenes", 0, "nodes"), [-1]),
    "scene by name": (("scene",), "main"),
    "animations null": (("animations",), None),
    "animations of numbers": (("animations",), [1]),
    "weights null": (("meshes", 0, "weights"), None),
    "primitives null": (("meshes", 0, "primitives"), None),
    "materials a dict": (("materials",), {"a": 1}),
    "material -1": (("meshes", 0, "primitives", 0, "material"), -1),
    "material 7": (("meshes", 0, "primitives", 0, "material"), 7),
    "material a name": (("meshes", 0, "primitives", 0, "material"), "red"),
    "colour of 3": ((*COLOR, "baseColorFactor"), [1, 1, 1]),
    "colour a name": ((*COLOR, "baseColorFactor"), "red!"),
    "metal NaN": ((*COLOR, "metallicFactor"), float("nan")),
    "texture -1": ((*COLOR, "baseColorTexture"), {"index": -1}),
    "image bad base64": (("images", 0, "uri"), "data:image/png;base64,abc"),
    "image not base64": (("images", 0, "uri"), "data:image/png,abcd"),
    "image uri a number": (("images", 0, "uri"), 7),
    "buffer bad base64": (("buffers", 0, "uri"), "data:;base64,abc"),
    "buffers null": (("buffers",), None),
    "accessor of an object": (("meshes", 0, "primitives", 0, "attributes", "POSITION"), {}),
    "coordinates as positions": (("meshes", 0, "primitives", 0, "attributes", "POSITION"), 1),
    "positions as coordinates": (("meshes", 0, "primitives", 0, "attributes", "TEXCOORD_0"), 0),
    "component type a list": ((*POSITION, "componentType"), [5126]),
    "normalised floats": ((*POSITION, "normalized"), True),
    "huge count": ((*POSITION, "count"), 10**13),
    "huge count without a view": (POSITION, {"componentType": 5126, "type": "VEC3", "count": 10**13}),
    "huge sparse": (
        (*POSITION, "sparse"),
        {
            "count": 10**13,
            "indices": {"bufferView": 0, "componentType": 5125},
            "values": {"bufferView": 0},
        },
    ),
    "count -1": ((*POSITION, "count"), -1),
    "count 3.5": ((*POSITION, "count"), 3.5),
    "count true": ((*POSITION, "count"), True),
    "accessor offset -8": ((*POSITION, "byteOffset"), -8),
    "accessor offset 4": ((*POSITION, "byteOffset"), 4),
    "view offset -8": ((*VIEW, "byteOffset"), -8),
    "view length -1": ((*VIEW, "byteLength"), -1),
    "view length 10**12": ((*VIEW, "byteLength"), 10**12),
    "stride -12": ((*VIEW, "byteStride"), -12),
    "stride 4": ((*VIEW, "byteStride"), 4),
    "stride a word": ((*VIEW, "byteStride"), "12"),
    "view in buffer -1": ((*VIEW, "buffer"), -1),
}  # fmt: skip


@pytest.mark.parametrize("case", MALFORMED)
def test_malformed_value_gets_one_clear_line(case, tmp_path):
    steps, value = MALFORMED[case]
    assert glb_problem(tmp_path, changed(*steps, value=value))


@pytest.mark.parametrize(
    "text", [b"[" * 100_000, b"[]", b"\xff", b'{"asset": {"version": "2.0"}, "nodes": 3}']
)
def test_malformed_json_gets_one_clear_line(text, tmp_path):
    (tmp_path / "a.gltf").write_bytes(text)
    assert problem_of(tmp_path / "a.gltf")


def test_reads_before_and_beyond_a_buffer_are_named(tmp_path):
    assert "byteOffset is -8" in glb_problem(tmp_path, changed(*POSITION, "byteOffset", value=-8))
    assert "byteStride is -12" in glb_problem(tmp_path, changed(*VIEW, "byteStride", value=-12))
    assert "byteStride of 4" in glb_problem(tmp_path, changed(*VIEW, "byteStride", value=4))
    assert "count is -1" in glb_problem(tmp_path, changed(*POSITION, "count", value=-1))
    assert "reaches beyond" in glb_problem(tmp_path, changed(*POSITION, "count", value=10**13))


def test_negative_index_of_a_face_is_refused(tmp_path):
    document = changed("meshes", 0, "primitives", 0, "indices", value=2)
    document["accessors"].append({"bufferView": 2, "componentType": 5120, "count": 3, "type": "SCALAR"})
    document["bufferViews"].append({"buffer": 0, "byteOffset": len(BINARY), "byteLength": 4})
    binary = BINARY + np.array([0, 1, -1, 0], dtype="<i1").tobytes()
    assert "a vertex that is not there" in glb_problem(tmp_path, document, binary)


def test_coordinates_of_a_texture_must_be_finite(tmp_path):
    binary = CORNERS + np.array([[0, 0], [1, 0], [0, np.nan]], dtype="<f4").tobytes()
    assert "NaN" in glb_problem(tmp_path, DOCUMENT, binary)
    plain = changed("materials", value=[{}])  # nothing is drawn by them
    (tmp_path / "b.glb").write_bytes(glb_bytes(plain, binary))
    assert not read_object(tmp_path / "b.glb", CONFIG).mesh.corner_uv.any()


@pytest.mark.parametrize("uri", ["a.png", "../a.png", "http://x/a.png", "file:///etc/passwd"])
def test_glb_refers_to_nothing_outside_of_it(tmp_path, uri):
    (tmp_path / "a.png").write_bytes(png())
    problem = glb_problem(tmp_path, changed("images", 0, "uri", value=uri))
    assert problem == f"refers to the texture {uri!r} outside of it"
    assert "the buffer" in glb_problem(tmp_path, changed("buffers", 0, "uri", value=uri))


@pytest.mark.parametrize(
    "uri",
    [
        "../a.png", "%2e%2e/a.png", "below/../../a.png", "..\\a.png", "/etc/passwd", "%2Fetc/passwd",
        "file:///etc/passwd", "http://x/a.png", "//x/a.png", "C:a.png", "DATA:image/png;base64,AAAA",
    ],
)  # fmt: skip
def test_gltf_refers_to_nothing_outside_of_its_folder(tmp_path, uri):
    folder = tmp_path / "model"
    folder.mkdir()
    (tmp_path / "a.png").write_bytes(png())
    document = changed("images", 0, "uri", value=uri) | {"buffers": [{"uri": in_data_uri(BINARY)}]}
    (folder / "a.gltf").write_text(json.dumps(document))
    assert problem_of(folder / "a.gltf").startswith("refers to the texture")


def test_gltf_reads_files_of_its_folder_and_below(tmp_path):
    (tmp_path / "my parts").mkdir()
    (tmp_path / "my parts" / "a.png").write_bytes(png())
    (tmp_path / "b.bin").write_bytes(BINARY)
    document = changed("images", 0, "uri", value="./my%20parts/a.png") | {"buffers": [{"uri": "b.bin"}]}
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    assert read_object(tmp_path / "a.gltf", CONFIG).mesh.materials[0].base_color_image == png()
