"""Where images lie: wrap modes, several UV sets, KHR_texture_transform; in and out again."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from datagen.objects.errors import ObjectError
from datagen.objects.formats.glb_export import mesh_to_glb
from datagen.objects.formats.reading import ReadingConfig, read_object
from datagen.objects.mesh.object_mesh import ImageLayout, ObjectMesh
from datagen.objects.mesh.surface_points import colors_at
from tests.datagen.objects.gltf_bytes import SQUARE_UV, GltfBytes

CONFIG = ReadingConfig(unit="m", up_axis="y", max_faces=5000, max_image_px=256)
REPEAT, MIRROR, CLAMP = 10497, 33648, 33071
# Linear 0 or 1 in each channel, so sRGB and linear agree; rows from the top.
QUADRANTS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]], dtype=np.uint8)


def png(pixels: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    return buffer.getvalue()


def quadrants(size: int = 64) -> bytes:
    """Four plain colours, large enough that blending at their borders is narrow."""
    return png(np.kron(QUADRANTS, np.ones((size // 2, size // 2, 1), np.uint8)))


def read(folder: Path, data: bytes) -> ObjectMesh:
    (folder / "a.glb").write_bytes(data)
    return read_object(folder / "a.glb", CONFIG).mesh


def color_at(mesh: ObjectMesh, x: float, y: float) -> np.ndarray:
    """Of the square at x to the right and y upward, 0..1; its triangles are (0, 1, 2) and (0, 2, 3)."""
    barycentric = np.array([1 - y, x, y - x] if y > x else [1 - x, x - y, y])
    placed = np.einsum("k,fkc->fc", barycentric, mesh.verts_obj[mesh.faces])
    face = np.abs(placed - [x - 0.5, 0, y - 0.5]).max(axis=1).argmin()
    return colors_at(mesh, np.array([face]), barycentric[None])[0]


def seen(s: float, t: float, wrap_s: int, wrap_t: int) -> np.ndarray:
    """Quadrant of the image at glTF's (s, t), which grows downward."""

    def folded(value: float, wrap: int) -> float:
        if wrap == CLAMP:
            return min(max(value, 0.0), 1.0)
        if wrap == MIRROR:
            value = value % 2
            return 2 - value if value > 1 else value
        return value % 1

    return QUADRANTS[int(folded(t, wrap_t) > 0.5), int(folded(s, wrap_s) > 0.5)] / 255


@pytest.mark.parametrize("wrap_t", [REPEAT, MIRROR, CLAMP])
@pytest.mark.parametrize("wrap_s", [REPEAT, MIRROR, CLAMP])
def test_wrap_modes_of_each_axis(tmp_path, wrap_s, wrap_t):
    """UVs from -1.5 to 2.5, looked up at the middle of each quadrant."""
    made = GltfBytes()
    texture = {"index": made.texture(quadrants(), wrapS=wrap_s, wrapT=wrap_t)}
    primitive = made.square(material=made.material(pbrMetallicRoughness={"baseColorTexture": texture}))
    primitive["attributes"]["TEXCOORD_0"] = made.accessor((SQUARE_UV * 4 - 1.5).astype("<f4"))
    mesh = read(tmp_path, made.glb())
    middles = np.arange(-1.25, 2.5, 0.5)
    for drawn in (mesh, read(tmp_path, mesh_to_glb(mesh))):
        for s in middles:
            for t in middles:
                x, y = (s + 1.5) / 4, 1 - (t + 1.5) / 4
                np.testing.assert_allclose(
                    color_at(drawn, x, y), seen(s, t, wrap_s, wrap_t), atol=1e-3, err_msg=f"at {s}, {t}"
                )


def test_a_clamped_image_does_not_bleed_over_its_border(tmp_path):
    """At the border itself, repeating mixes opposite sides."""
    image = png(np.repeat(np.array([[[255, 0, 0]], [[0, 0, 255]]], np.uint8), 2, axis=1))
    for wrap, expected in ((CLAMP, (1, 0, 0)), (MIRROR, (1, 0, 0)), (REPEAT, None)):
        made = GltfBytes()
        texture = {"index": made.texture(image, wrapS=REPEAT, wrapT=wrap)}
        made.square(material=made.material(pbrMetallicRoughness={"baseColorTexture": texture}))
        color = color_at(read(tmp_path, made.glb()), 0.3, 1.0)
        if expected is None:
            assert color[0] == pytest.approx(color[2])
        else:
            np.testing.assert_allclose(color, expected, atol=1e-6)


def test_the_plain_case_writes_no_sampler(tmp_path):
    made = GltfBytes()
    texture = {"index": made.texture(quadrants(), wrapS=REPEAT, wrapT=REPEAT, magFilter=9729)}
    made.square(material=made.material(pbrMetallicRoughness={"baseColorTexture": texture}))
    stored = mesh_to_glb(read(tmp_path, made.glb()))
    assert b"sampler" not in stored
    assert b"TEXCOORD_1" not in stored


def test_an_unknown_wrap_mode_is_named(tmp_path):
    made = GltfBytes()
    texture = {"index": made.texture(quadrants(), wrapS=1)}
    made.square(material=made.material(pbrMetallicRoughness={"baseColorTexture": texture}))
    with pytest.raises(ObjectError, match=r"wrap modes \[1, 10497\]"):
        read(tmp_path, made.glb())


def test_each_image_has_the_set_and_transform_that_it_names(tmp_path):
    """Base colour by TEXCOORD_1, emission by TEXCOORD_0 tiled 3 times, normals as the base: two layers."""
    made = GltfBytes()
    image = made.texture(quadrants())
    base = {"index": image, "texCoord": 1}
    tiled = {"index": image, "extensions": {"KHR_texture_transform": {"scale": [3, 3]}}}
    primitive = made.square(
        material=made.material(
            pbrMetallicRoughness={"baseColorTexture": base},
            emissiveTexture=tiled,
            emissiveFactor=[1, 1, 1],
            normalTexture=base,
        )
    )
    primitive["attributes"]["TEXCOORD_1"] = made.accessor((SQUARE_UV * 0.5).astype("<f4"))
    mesh = read(tmp_path, made.glb())
    for drawn in (mesh, read(tmp_path, mesh_to_glb(mesh))):
        (material,) = drawn.materials
        assert material.base_color_layout == material.normal_layout == ImageLayout(uv_layer=0)
        assert material.emissive_layout == ImageLayout(uv_layer=1)
        assert np.ptp(drawn.corner_uv, axis=(0, 1)) == pytest.approx([0.5, 0.5])
        (other,) = drawn.more_corner_uv
        assert np.ptp(other, axis=(0, 1)) == pytest.approx([3, 3])


def test_the_first_image_decides_where_there_is_no_base_colour(tmp_path):
    made = GltfBytes()
    normals = {"index": made.texture(quadrants()), "texCoord": 1}
    primitive = made.square(material=made.material(normalTexture=normals))
    primitive["attributes"]["TEXCOORD_1"] = made.accessor((SQUARE_UV * 0.25).astype("<f4"))
    mesh = read(tmp_path, made.glb())
    assert mesh.materials[0].normal_layout.uv_layer == 0
    assert np.ptp(mesh.corner_uv, axis=(0, 1)) == pytest.approx([0.25, 0.25])
    assert mesh.more_corner_uv == ()


def test_materials_with_fewer_layers_share_a_mesh(tmp_path):
    made = GltfBytes()
    image = made.texture(quadrants())
    turned = {"index": image, "extensions": {"KHR_texture_transform": {"offset": [0.5, 0]}}}
    both = made.material(pbrMetallicRoughness={"baseColorTexture": {"index": image}}, normalTexture=turned)
    plain = made.material(pbrMetallicRoughness={"baseColorTexture": {"index": image}})
    made.square(material=both)
    made.square(material=plain, offset=(2, 0, 0))
    mesh = read(tmp_path, made.glb())
    stored = mesh_to_glb(mesh)
    assert stored.count(b"TEXCOORD_1") == 1
    back = read(tmp_path, stored)
    assert len(back.faces) == 4
    np.testing.assert_allclose(back.more_corner_uv[0], mesh.more_corner_uv[0], atol=1e-6)


def test_the_example_of_the_transform_shows_the_lower_left_quadrant(tmp_path):
    """KHR_texture_transform: offset (0, 1), rotation 90 degrees, scale 0.5."""
    made = GltfBytes()
    moved = {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}
    texture = {"index": made.texture(quadrants()), "extensions": {"KHR_texture_transform": moved}}
    made.square(material=made.material(pbrMetallicRoughness={"baseColorTexture": texture}))
    mesh = read(tmp_path, made.glb())
    for x in (0.1, 0.5, 0.9):
        for y in (0.1, 0.5, 0.9):
            np.testing.assert_allclose(color_at(mesh, x, y), QUADRANTS[1, 0] / 255, atol=1e-3)


def test_images_that_are_converted_together_must_lie_alike(tmp_path):
    made = GltfBytes()
    image = made.texture(quadrants())
    look = {"diffuseTexture": {"index": image}, "specularGlossinessTexture": {"index": image, "texCoord": 1}}
    made.square(material=made.material(extensions={"KHR_materials_pbrSpecularGlossiness": look}))
    with pytest.raises(ObjectError, match="have other coordinates or wrapping"):
        read(tmp_path, made.glb())


def test_an_image_without_coordinates_is_noted(tmp_path):
    made = GltfBytes()
    texture = {"index": made.texture(quadrants()), "texCoord": 1}
    made.square(material=made.material(name="lid", pbrMetallicRoughness={"baseColorTexture": texture}))
    (tmp_path / "a.glb").write_bytes(made.glb())
    (note,) = read_object(tmp_path / "a.glb", CONFIG).notes
    assert note == "material 'lid' has images and a primitive no TEXCOORD_1"


def test_one_image_used_twice_is_stored_once(tmp_path):
    made = GltfBytes()
    image = quadrants()
    clamped, repeated = made.texture(image, wrapS=CLAMP, wrapT=CLAMP), made.texture(image)
    for offset, index in (((0, 0, 0), clamped), ((2, 0, 0), repeated)):
        pbr = {"baseColorTexture": {"index": index}}
        made.square(material=made.material(pbrMetallicRoughness=pbr), offset=offset)
    stored = mesh_to_glb(read(tmp_path, made.glb()))
    document = json.loads(stored[20 : 20 + int.from_bytes(stored[12:16], "little")])
    assert (len(document["images"]), len(document["textures"]), len(document["samplers"])) == (1, 2, 1)
