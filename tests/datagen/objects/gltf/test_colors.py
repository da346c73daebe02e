"""Base colour factor, texture, vertex colours and emission: what multiplies what, in and out again."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from datagen.objects.errors import ObjectError
from datagen.objects.formats.glb_export import mesh_to_glb
from datagen.objects.formats.reading import ReadingConfig, read_object
from datagen.objects.mesh.object_mesh import ObjectMesh
from datagen.objects.mesh.surface_points import sample_surface
from datagen.objects.mesh.texture_quality import measure_texture_quality
from shards.color import linear_from_srgb, srgb_from_linear
from tests.datagen.objects.gltf_bytes import GltfBytes

CONFIG = ReadingConfig(unit="m", up_axis="y", max_faces=5000, max_image_px=256)
FACTOR, TINT, GREY = (0.8, 0.5, 0.2, 1.0), (0.5, 0.25, 1.0), 188  # of an image, sRGB


def png(color: Any, size: tuple[int, int] = (4, 4)) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", size, color).save(buffer, format="PNG")
    return buffer.getvalue()


def read(folder: Path, data: bytes) -> ObjectMesh:
    (folder / "a.glb").write_bytes(data)
    return read_object(folder / "a.glb", CONFIG).mesh


def linear_colors(mesh: ObjectMesh) -> np.ndarray:
    return linear_from_srgb(sample_surface(mesh, 300, np.random.default_rng(0)).colors)


COLOR_ROWS = {
    "float RGB": np.array([TINT] * 4, dtype="<f4"),
    "float RGBA": np.array([(*TINT, 0.3)] * 4, dtype="<f4"),
    "bytes RGB": np.round(np.array([TINT] * 4) * 255).astype("u1"),
    "bytes RGBA": np.round(np.array([(*TINT, 0.3)] * 4) * 255).astype("u1"),
    "shorts RGB": np.round(np.array([TINT] * 4) * 65535).astype("<u2"),
    "shorts RGBA": np.round(np.array([(*TINT, 0.3)] * 4) * 65535).astype("<u2"),
}


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("kind", COLOR_ROWS)
def test_factor_texture_and_vertex_colour_multiply(tmp_path, kind, stated):
    """COLOR_0 of every type; integers are shares also where a file forgets `normalized`."""
    rows, made = COLOR_ROWS[kind], GltfBytes()
    image = made.texture(png((GREY, GREY, GREY)))
    pbr = {"baseColorFactor": FACTOR, "baseColorTexture": {"index": image}}
    normalized = {"normalized": True} if stated and rows.dtype.kind == "u" else {}
    primitive = made.square(material=made.material(pbrMetallicRoughness=pbr))
    primitive["attributes"]["COLOR_0"] = made.accessor(rows, **normalized)
    mesh = read(tmp_path, made.glb())
    expected = np.array(FACTOR[:3]) * TINT * linear_from_srgb(np.array(GREY / 255))
    np.testing.assert_allclose(linear_colors(mesh), [expected] * 300, atol=0.5 / 255)
    np.testing.assert_allclose(
        linear_colors(read(tmp_path, mesh_to_glb(mesh))), [expected] * 300, atol=0.5 / 255
    )


def test_white_vertex_colours_leave_no_trace(tmp_path):
    made = GltfBytes()
    primitive = made.square(material=made.material(pbrMetallicRoughness={"baseColorFactor": [1, 0, 0, 1]}))
    primitive["attributes"]["COLOR_0"] = made.accessor(np.full((4, 4), 255, "u1"), normalized=True)
    mesh = read(tmp_path, made.glb())
    assert mesh.corner_colors is None
    np.testing.assert_allclose(linear_colors(mesh), [[1, 0, 0]] * 300)
    assert b"COLOR_0" not in mesh_to_glb(mesh)


def test_colours_of_one_primitive_leave_the_others_alone(tmp_path):
    made = GltfBytes()
    white, grey = (made.material(pbrMetallicRoughness={"baseColorFactor": [c, c, c, 1]}) for c in (1.0, 0.2))
    colored = made.square(material=white)
    colored["attributes"]["COLOR_0"] = made.accessor(np.array([[0, 255, 0]] * 4, "u1"), normalized=True)
    made.square(material=grey, offset=(2, 0, 0))
    mesh = read(tmp_path, made.glb())
    for read_mesh in (mesh, read(tmp_path, mesh_to_glb(mesh))):
        samples = sample_surface(read_mesh, 300, np.random.default_rng(0))
        left = samples.points_obj[:, 0] < 0
        np.testing.assert_allclose(samples.colors[left], [[0, 1, 0]] * left.sum(), atol=1e-6)
        shown = float(srgb_from_linear(np.array(0.2)))
        np.testing.assert_allclose(samples.colors[~left], [[shown] * 3] * (~left).sum(), atol=1e-6)
    assert mesh_to_glb(mesh).count(b"COLOR_0") == 1


def test_vertex_colours_are_interpolated_in_linear_light(tmp_path):
    """Black to white along x: the linear colour is the place."""
    made = GltfBytes()
    primitive = made.square()
    primitive["attributes"]["COLOR_0"] = made.accessor(
        np.array([[0, 0, 0], [1, 1, 1], [1, 1, 1], [0, 0, 0]], "<f4")
    )
    mesh = read(tmp_path, made.glb())
    samples = sample_surface(mesh, 300, np.random.default_rng(0))
    np.testing.assert_allclose(
        linear_from_srgb(samples.colors), np.repeat(samples.points_obj[:, :1] + 0.5, 3, axis=1), atol=1e-6
    )
    quality = measure_texture_quality(mesh)
    assert quality.texture_resolution_px == 2  # the root of four vertices that have a colour
    assert quality.color_detail > 0.1


def test_colours_that_are_no_numbers_are_refused(tmp_path):
    made = GltfBytes()
    made.square()["attributes"]["COLOR_0"] = made.accessor(np.full((4, 3), np.nan, "<f4"))
    with pytest.raises(ObjectError, match="vertex colours that are NaN"):
        read(tmp_path, made.glb())


@pytest.mark.parametrize(
    ("base", "glow", "shown"),
    [
        ((0, 0, 0, 1), (1, 1, 1), (0.2, 0.6, 0.05)),  # baked light: the image
        ((0, 0, 0, 1), (0.5, 0.5, 0.5), (0.1, 0.3, 0.025)),
        ((0.1, 0.1, 0.1, 1), (1, 1, 1), (0.2, 0.6, 0.1)),  # a screen in dark glass
        ((1, 1, 1, 1), (1, 1, 1), (1, 1, 1)),
        ((0.3, 0.3, 0.3, 1), (0, 0, 0), (0.3, 0.3, 0.3)),
    ],
)
def test_what_glows_is_the_colour_where_it_is_brighter(tmp_path, base, glow, shown):
    made = GltfBytes()
    color = np.round(255 * srgb_from_linear(np.array([0.2, 0.6, 0.05]))).astype(int)
    emissive = {"index": made.texture(png(tuple(int(c) for c in color)))}
    pbr = {"baseColorFactor": base}
    made.square(
        material=made.material(pbrMetallicRoughness=pbr, emissiveFactor=glow, emissiveTexture=emissive)
    )
    mesh = read(tmp_path, made.glb())
    for read_mesh in (mesh, read(tmp_path, mesh_to_glb(mesh))):
        np.testing.assert_allclose(linear_colors(read_mesh), [shown] * 300, atol=1 / 255)
    # What Blender is told stays as the file says.
    assert mesh.materials[0].base_color_rgba == base
    assert mesh.materials[0].emissive_rgb == glow


def test_texture_quality_of_baked_light_is_that_of_its_image(tmp_path):
    made = GltfBytes()
    emissive = {"index": made.texture(png((9, 99, 200), (64, 64)))}
    pbr = {"baseColorFactor": [0, 0, 0, 1]}
    made.square(
        material=made.material(pbrMetallicRoughness=pbr, emissiveFactor=[1, 1, 1], emissiveTexture=emissive)
    )
    assert measure_texture_quality(read(tmp_path, made.glb())).texture_resolution_px == 64


def test_factors_beyond_their_range_are_clipped(tmp_path):
    """The stored mesh must be valid whatever the file says."""
    made = GltfBytes()
    pbr = {"baseColorFactor": [1.5, -0.1, 0.5, 1], "metallicFactor": 2, "roughnessFactor": -1}
    made.square(material=made.material(pbrMetallicRoughness=pbr))
    material = read(tmp_path, made.glb()).materials[0]
    assert list(material.base_color_rgba) == [1, 0, 0.5, 1]
    assert (material.metallic, material.roughness) == (1, 0)
