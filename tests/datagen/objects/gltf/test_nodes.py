"""What of a scene is drawn: instances, hidden nodes, what moves and what only might, required extensions."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.objects.errors import ObjectError
from datagen.objects.formats.reading import ReadingConfig, ReadObject, read_object
from tests.datagen.objects.gltf_bytes import SQUARE, GltfBytes

CONFIG = ReadingConfig(unit="m", up_axis="y", max_faces=50, max_image_px=256)


def read(folder: Path, made: GltfBytes) -> ReadObject:
    (folder / "a.glb").write_bytes(made.glb())
    return read_object(folder / "a.glb", CONFIG)


def size(folder: Path, made: GltfBytes) -> list[float]:
    """Along glTF's x, y and z."""
    x, z, y = np.ptp(read(folder, made).mesh.verts_obj, axis=0)
    return [float(x), float(y), float(z)]


def square(**document: Any) -> GltfBytes:
    made = GltfBytes(**document)
    made.square()
    return made


HALF_TURN = np.array([[0, 0, 0, 1], [0, 0, 1, 0]])  # none, and 180 degrees about z


@pytest.mark.parametrize("kind", ["floats", "shorts"])
def test_all_instances_are_drawn(tmp_path, kind):
    """Placed below the node: scaled by its 2, moved by its 10; the second turned about its own corner."""
    made = square()
    rotation = HALF_TURN.astype("<f4") if kind == "floats" else (HALF_TURN * 32767).astype("<i2")
    attributes = {
        "TRANSLATION": made.accessor(np.array([[0, 0, 0], [4, 0, 0]], "<f4")),
        "ROTATION": made.accessor(rotation, **({} if kind == "floats" else {"normalized": True})),
        "SCALE": made.accessor(np.array([[1, 1, 1], [1, 3, 1]], "<f4")),
        "_ID": made.accessor(np.array([0, 1], "<f4")),
    }
    made.json["nodes"] = [
        {
            "mesh": 0,
            "scale": [2, 2, 2],
            "translation": [10, 0, 0],
            "extensions": {"EXT_mesh_gpu_instancing": {"attributes": attributes}},
        }
    ]
    mesh = read(tmp_path, made).mesh
    assert len(mesh.faces) == 4
    # x: 0..2 and 8 - 2..8; y: 0..2 and -6..0
    np.testing.assert_allclose(np.ptp(mesh.verts_obj, axis=0), [8, 0, 8], atol=1e-6)


def test_instances_of_different_length_are_named(tmp_path):
    made = square()
    attributes = {
        "TRANSLATION": made.accessor(np.zeros((2, 3), "<f4")),
        "SCALE": made.accessor(np.ones((3, 3), "<f4")),
    }
    made.json["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    with pytest.raises(ObjectError, match="attributes of EXT_mesh_gpu_instancing differ in length"):
        read(tmp_path, made)


def test_a_small_file_cannot_place_more_triangles_than_are_allowed(tmp_path):
    made = square()
    places = made.accessor(np.zeros((26, 3), "<f4"))
    made.json["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": places}}}
    with pytest.raises(ObjectError, match="has 52 triangles; expected at most 50"):
        read(tmp_path, made)


def test_hidden_nodes_and_what_is_below_them_are_left_out(tmp_path):
    hidden = {"extensions": {"KHR_node_visibility": {"visible": False}}}
    shown = {"extensions": {"KHR_node_visibility": {"visible": True}}}
    made = square(
        scenes=[{"nodes": [0, 1, 3]}],
        nodes=[
            {"mesh": 0, **shown},
            {"children": [2], **hidden},
            {"mesh": 0, "translation": [9, 0, 0]},
            {"mesh": 0, "translation": [0, 9, 0], **hidden},
        ],
        extensionsRequired=["KHR_node_visibility"],
    )
    assert size(tmp_path, made) == [1, 1, 0]


def test_coarser_levels_of_detail_are_not_drawn_over_the_finest(tmp_path):
    made = square(
        nodes=[
            {"mesh": 0, "extensions": {"MSFT_lod": {"ids": [1]}}},
            {"mesh": 0, "translation": [5, 0, 0]},
        ],
        extensionsRequired=["MSFT_lod"],
    )
    del made.json["scenes"], made.json["scene"]
    assert size(tmp_path, made) == [1, 1, 0]


def animated(path: str, rows: np.ndarray, *, node: int = 0, keys: int = 2, **sampler: Any) -> GltfBytes:
    made = square(nodes=[{"mesh": 0, "children": [1]}, {"name": "camera"}])
    sampler = {"input": made.accessor(np.arange(keys, dtype="<f4")), "output": made.accessor(rows), **sampler}
    channel = {"sampler": 0, "target": {"node": node, "path": path}}
    made.json["animations"] = [{"samplers": [sampler], "channels": [channel]}]
    return made


MOVING = np.array([[0, 0, 0], [1, 0, 0]], "<f4")
STILL = np.array([[1, 2, 3], [1, 2, 3]], "<f4")
CUBIC = np.zeros((6, 3), "<f4")  # in-tangent, value, out-tangent of each key

RIGID = {
    "of a camera": animated("translation", MOVING, node=1),
    "of one key": animated("translation", MOVING[1:], keys=1),
    "that holds still": animated("translation", STILL),
    "that holds still, cubic": animated("translation", CUBIC, interpolation="CUBICSPLINE"),
    "without channels": square(animations=[{"samplers": [], "channels": []}]),
    "of nothing": square(
        animations=[{"samplers": [], "channels": [{"sampler": 0, "target": {"path": "scale"}}]}]
    ),
    "skin that no mesh uses": square(skins=[{"joints": [0]}]),
    "skin of a hidden mesh": square(
        nodes=[
            {"mesh": 0},
            {"mesh": 0, "skin": 0, "extensions": {"KHR_node_visibility": {"visible": False}}},
        ],
        scenes=[{"nodes": [0, 1]}],
        skins=[{"joints": [0]}],
    ),
    "morph targets without weight": square(nodes=[{"mesh": 0, "weights": [0, 0]}]),
}


@pytest.mark.parametrize("case", RIGID)
def test_what_moves_nothing_drawn_is_no_reason_to_refuse(tmp_path, case):
    assert size(tmp_path, RIGID[case]) == [1, 1, 0]


def test_a_still_animation_of_the_object_is_noted(tmp_path):
    assert read(tmp_path, animated("translation", STILL)).notes == (
        "its animation holds still; drawn in the pose of its nodes",
    )
    assert read(tmp_path, animated("translation", MOVING, node=1)).notes == ()


def pointed(pointer: str) -> GltfBytes:
    made = animated("pointer", MOVING)
    made.json["animations"][0]["channels"][0]["target"] = {
        "path": "pointer",
        "extensions": {"KHR_animation_pointer": {"pointer": pointer}},
    }
    return made


def below(node: dict[str, Any]) -> GltfBytes:
    """The mesh hangs below the animated node."""
    made = animated("rotation", np.array([[0, 0, 0, 1], [0, 0, 1, 0]], "<f4"))
    made.json["nodes"] = [{"children": [1]}, node]
    return made


MOVES = {
    "translation": (animated("translation", MOVING), r"is animated \(1 animations\)"),
    "of the parent": (below({"mesh": 0}), "is animated"),
    "by tangents alone": (
        animated(
            "scale", CUBIC + np.array([[0], [0], [1], [0], [0], [0]], "<f4"), interpolation="CUBICSPLINE"
        ),
        "is animated",
    ),
    "weights": (animated("weights", np.array([0, 1], "<f4")), "animates morph targets"),
    "by a pointer": (pointed("/nodes/0/translation"), "is animated"),
    "morphed": (square(nodes=[{"mesh": 0, "weights": [0, 0.5]}]), "is deformed by morph targets"),
    "skinned": (square(nodes=[{"mesh": 0, "skin": 0}], skins=[{"joints": [0]}]), r"is skinned \(1 skins\)"),
}


@pytest.mark.parametrize("case", MOVES)
def test_what_moves_is_refused(tmp_path, case):
    made, message = MOVES[case]
    with pytest.raises(ObjectError, match=message):
        read(tmp_path, made)


def test_a_pointer_to_something_else_moves_nothing(tmp_path):
    assert size(tmp_path, pointed("/materials/0/emissiveFactor")) == [1, 1, 0]


@pytest.mark.parametrize(
    "extension",
    [
        "KHR_materials_variants", "KHR_materials_clearcoat", "KHR_materials_sheen", "KHR_lights_punctual",
        "KHR_xmp", "KHR_xmp_json_ld", "MSFT_lod", "KHR_texture_basisu", "EXT_meshopt_compression",
        "EXT_mesh_gpu_instancing", "KHR_node_visibility",
    ],
)  # fmt: skip
def test_required_extensions_that_change_no_shape_are_accepted(tmp_path, extension):
    assert size(tmp_path, square(extensionsRequired=[extension])) == [1, 1, 0]


def test_an_unknown_required_extension_is_named(tmp_path):
    with pytest.raises(ObjectError, match="requires EXT_of_tomorrow; expected"):
        read(tmp_path, square(extensionsRequired=["KHR_materials_sheen", "EXT_of_tomorrow"]))


def test_what_is_not_drawn_of_a_material_is_noted(tmp_path):
    made = GltfBytes()
    made.square(
        material=made.material(
            name="car",
            alphaMode="BLEND",
            pbrMetallicRoughness={"baseColorFactor": [1, 1, 1, 0.5]},
            extensions={"KHR_materials_sheen": {}, "KHR_materials_clearcoat": {}, "KHR_materials_ior": {}},
        )
    )
    made.json["meshes"][0]["primitives"].append(
        {"attributes": {"POSITION": made.accessor(SQUARE)}, "mode": 0}
    )
    made.material(name="unused", extensions={"KHR_materials_volume": {}})
    assert read(tmp_path, made).notes == (
        "1 of 2 primitives are points or lines",
        "material 'car' is drawn without KHR_materials_clearcoat, KHR_materials_sheen",
        "material 'car' (BLEND) is drawn opaque: masks and images show one outline",
    )


def test_a_blended_material_without_transparency_is_not_noted(tmp_path):
    made = GltfBytes()
    made.square(material=made.material(alphaMode="BLEND"))
    assert read(tmp_path, made).notes == ()
