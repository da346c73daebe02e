"""Containers as writers of all kinds make them: padding, encodings, old versions, packed buffers, URIs."""

import base64
import io
import json
import unicodedata
from pathlib import Path
from urllib.parse import quote, quote_from_bytes

import numpy as np
import pytest
from PIL import Image

from datagen.objects.errors import ObjectError
from datagen.objects.formats.reading import ReadingConfig, read_object
from datagen.objects.gltf.container import UNPACKING
from datagen.objects.mesh.object_mesh import ObjectMesh
from tests.datagen.objects.gltf_bytes import GltfBytes, glb_of

CONFIG = ReadingConfig(unit="m", up_axis="y", max_faces=50, max_image_px=256)


def png() -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (8, 8), (200, 30, 30)).save(buffer, format="PNG")
    return buffer.getvalue()


def square() -> GltfBytes:
    made = GltfBytes()
    made.square()
    return made


def text_of(made: GltfBytes, uri: str | None = None) -> bytes:
    buffer = {"byteLength": len(made.binary), **({} if uri is None else {"uri": uri})}
    return json.dumps({**made.json, "buffers": [buffer]}).encode()


def read(path: Path, data: bytes) -> ObjectMesh:
    path.write_bytes(data)
    return read_object(path, CONFIG).mesh


def is_square(mesh: ObjectMesh) -> bool:
    return bool(np.allclose(np.ptp(mesh.verts_obj, axis=0), [1, 0, 1])) and len(mesh.faces) == 2


@pytest.mark.parametrize("padding", [b" ", b"\0", b"\n", b"\t"])
def test_the_json_chunk_may_be_padded_with_anything_blank(tmp_path, padding):
    made = square()
    text = text_of(made)
    text += padding * (4 + -len(text) % 4)
    assert is_square(read(tmp_path / "a.glb", glb_of(text, made.binary, padding)))


@pytest.mark.parametrize("behind", [b"\0" * 3, b"\n", b"trailing bytes of a download", bytes(64)])
def test_bytes_behind_the_file_are_left_alone(tmp_path, behind):
    assert is_square(read(tmp_path / "a.glb", square().glb() + behind))


@pytest.mark.parametrize("stated", [0, 12, 2**32 - 1])
def test_a_wrong_total_length_does_not_matter(tmp_path, stated):
    data = square().glb()
    assert is_square(read(tmp_path / "a.glb", data[:8] + stated.to_bytes(4, "little") + data[12:]))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_text_files_with_byte_order_marks_are_read(tmp_path, encoding):
    made = square()
    text = text_of(made, "data:;base64," + base64.b64encode(made.binary).decode()).decode()
    assert is_square(read(tmp_path / "a.gltf", text.encode(encoding)))


def test_letters_of_another_encoding_do_not_matter(tmp_path):
    made = square()
    made.json["asset"]["generator"] = "XXX"
    data = made.glb().replace(b"XXX", "ü\xa9!".encode("latin-1"))
    assert is_square(read(tmp_path / "a.glb", data))


OLD = {
    "binary": b"glTF\1\0\0\0\x60\0\0\0\x4c\0\0\0\0\0\0\0" + b'{"asset": {"version": "1.0"}}',
    "text": b'{"asset": {"version": "1.0"}, "meshes": {}}',
    "text without a version": b'{"asset": {}, "meshes": {"box": {}}, "buffers": {}}',
}


@pytest.mark.parametrize("kind", OLD)
def test_the_first_version_is_refused_by_its_name(tmp_path, kind):
    with pytest.raises(
        ObjectError, match=r"is glTF 1\.0; expected glTF 2\.0\. Convert it: `npx gltf-pipeline"
    ):
        read(tmp_path / "a.gltf", OLD[kind])


def packed(extension: str, *, plain_copy: str | None, with_uri: bool) -> GltfBytes:
    """As gltfpack writes it: bufferViews of a second buffer, which may lie elsewhere or nowhere."""
    made = square()
    made.json |= {"extensionsUsed": [extension], "extensionsRequired": [extension]}
    for view in made.json["bufferViews"]:
        view["extensions"] = {extension: {"buffer": 0, "byteLength": 4, "byteStride": 4, "count": 1}}
        view["buffer"] = 1
    fallback = {"byteLength": len(made.binary), "extensions": {extension: {"fallback": True}}}
    if plain_copy is not None:
        fallback["uri"] = plain_copy
    first = {"byteLength": 4, **({"uri": "data:;base64,AAAAAA=="} if with_uri else {})}
    made.json["buffers"] = [first, fallback]
    return made


@pytest.mark.parametrize("suffix", ["glb", "gltf"])
@pytest.mark.parametrize("extension", ["EXT_meshopt_compression", "KHR_meshopt_compression"])
def test_packed_buffers_are_read_by_their_plain_copy_or_named(tmp_path, extension, suffix):
    path, plain = tmp_path / f"a.{suffix}", square().binary
    inside = "data:;base64," + base64.b64encode(plain).decode()
    (tmp_path / "a.fallback.bin").write_bytes(plain)
    for plain_copy in (inside, "a.fallback.bin", None, "left behind.bin"):
        made = packed(extension, plain_copy=plain_copy, with_uri=suffix == "gltf")
        text = json.dumps(made.json).encode()
        data = text if suffix == "gltf" else glb_of(text, b"\0\0\0\0")
        if plain_copy in (inside, "a.fallback.bin"):
            assert is_square(read(path, data))
            continue
        with pytest.raises(ObjectError, match=f"is packed with {extension}, without a plain copy") as caught:
            read(path, data)
        assert caught.value.action == f"Unpack it: `{UNPACKING[extension]}`."


def data_uris() -> dict[str, str]:
    plain = base64.b64encode(square().binary).decode()
    return {
        "media type": f"data:application/gltf-buffer;base64,{plain}",
        "none": f"data:;base64,{plain}",
        "charset": f"data:application/octet-stream;charset=utf-8;base64,{plain}",
        "capitals": f"data:application/octet-stream;BASE64,{plain}",
        "unpadded": f"data:;base64,{plain.rstrip('=')}",
        "letters of URLs": f"data:;base64,{plain.replace('+', '-').replace('/', '_')}",
        "line breaks": "data:;base64," + "\r\n".join(plain[k : k + 76] for k in range(0, len(plain), 76)),
        "percent-encoded base64": f"data:;base64,{quote(plain, safe='')}",
        "percent-encoded bytes": f"data:application/octet-stream,{quote_from_bytes(square().binary)}",
    }


@pytest.mark.parametrize("kind", data_uris())
def test_data_uris(tmp_path, kind):
    assert is_square(read(tmp_path / "a.gltf", text_of(square(), data_uris()[kind])))


@pytest.mark.parametrize("uri", ["data:;base64,A", "data:;base64,????", "data:nothing"])
def test_a_broken_data_uri_is_named(tmp_path, uri):
    with pytest.raises(ObjectError, match="the data uri of a buffer cannot be decoded"):
        read(tmp_path / "a.gltf", text_of(square(), uri))


NAMES = [  # on the disk, in the file
    ("blaue Tasse ä.bin", "blaue%20Tasse%20%C3%A4.bin"),
    ("blaue Tasse ä.bin", "blaue Tasse ä.bin"),
    (unicodedata.normalize("NFD", "Tasse ä.bin"), "Tasse%20%C3%A4.bin"),
    ("100% wood.bin", "100% wood.bin"),
    ("a%20b.bin", "a%20b.bin"),
    ("parts/a.bin", "parts\\a.bin"),
    ("parts/a.bin", "./parts/a.bin"),
    ("Parts/A.BIN", "parts/a.bin"),
    ("a#b?.bin", "a#b?.bin"),
    ("杯子.bin", "%E6%9D%AF%E5%AD%90.bin"),
]


@pytest.mark.parametrize(("on_disk", "in_file"), NAMES)
def test_names_of_files_beside_it(tmp_path, on_disk, in_file):
    made = square()
    (tmp_path / on_disk).parent.mkdir(exist_ok=True)
    (tmp_path / on_disk).write_bytes(made.binary)
    assert is_square(read(tmp_path / "a.gltf", text_of(made, in_file)))


def test_a_link_does_not_lead_out_of_the_folder(tmp_path):
    made, folder = square(), tmp_path / "model"
    folder.mkdir()
    for place in (tmp_path / "private.bin", folder / "own.bin"):
        place.write_bytes(made.binary)
    (folder / "out.bin").symlink_to(tmp_path / "private.bin")
    (folder / "in.bin").symlink_to("own.bin")
    assert is_square(read(folder / "in.gltf", text_of(made, "in.bin")))
    with pytest.raises(
        ObjectError, match=r"buffer 'out\.bin' is missing; expected .* no link out of the folder"
    ):
        read(folder / "out.gltf", text_of(made, "out.bin"))


def test_a_name_that_two_files_could_mean_is_missing(tmp_path):
    made = square()
    for name in ("A.bin", "a.BIN"):
        (tmp_path / name).write_bytes(made.binary)
    with pytest.raises(ObjectError, match=r"buffer 'a\.bin' is missing"):
        read(tmp_path / "m.gltf", text_of(made, "a.bin"))


@pytest.mark.parametrize("uri", ["a" * 300 + ".bin", "a\0b.bin", "a.gltf/b.bin"])
def test_names_that_no_file_can_have_are_missing(tmp_path, uri):
    with pytest.raises(ObjectError, match="is missing"):
        read(tmp_path / "a.gltf", text_of(square(), uri))


def test_a_texture_with_a_gpu_format_is_read_by_its_png(tmp_path):
    made = GltfBytes(extensionsUsed=["KHR_texture_basisu"], extensionsRequired=["KHR_texture_basisu"])
    texture = made.texture(png())
    made.texture(b"\xabKTX 20\xbb\r\n\x1a\n" + bytes(64), "image/ktx2")
    made.json["textures"][texture]["extensions"] = {"KHR_texture_basisu": {"source": 1}}
    made.square(material=made.material(pbrMetallicRoughness={"baseColorTexture": {"index": texture}}))
    assert read(tmp_path / "a.glb", made.glb()).materials[0].base_color_image == png()
    del made.json["textures"][texture]["source"]
    with pytest.raises(ObjectError, match="texture 0 exists as KHR_texture_basisu only"):
        read(tmp_path / "b.glb", made.glb())
    made.json["textures"][texture] = {"source": 1}
    with pytest.raises(ObjectError, match="is KTX; expected PNG"):
        read(tmp_path / "c.glb", made.glb())
