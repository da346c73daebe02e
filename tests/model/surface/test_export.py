"""Files come back as they were written, in the axes and colours that their formats want."""

import io
import json
import struct

import numpy as np
import pytest
import trimesh

from model.surface.export import glb_bytes, voxel_mesh, voxels_ply
from model.surface.extraction import ExtractionConfig, extract_surface
from model.surface.mesh import SurfaceMesh
from shards.color import srgb_from_linear
from tests.model.surface.shells import ball, shell_fields


@pytest.fixture(scope="module")
def mesh() -> SurfaceMesh:
    plain = extract_surface(shell_fields(32, ball(0.4), coarse=8), ExtractionConfig(seal=1)).mesh
    colors = np.round(255 * np.random.default_rng(0).random(plain.colors.shape) ** 2) / 255  # many dark ones
    return SurfaceMesh(vertices=plain.vertices, faces=plain.faces, colors=colors.astype(np.float32))


def _chunks(glb: bytes) -> tuple[dict, bytes]:
    (length,) = struct.unpack("<I", glb[12:16])
    return json.loads(glb[20 : 20 + length]), glb[28 + length :]


def _accessor(glb: bytes, number: int) -> np.ndarray:
    tree, binary = _chunks(glb)
    accessor = tree["accessors"][number]
    assert (accessor["componentType"], accessor["type"]) == (5126, "VEC3")
    start = tree["bufferViews"][accessor["bufferView"]].get("byteOffset", 0)
    return np.frombuffer(binary, "<f4", 3 * accessor["count"], start).reshape(-1, 3)


def test_glb_holds_positions_normals_and_linear_colours(mesh: SurfaceMesh) -> None:
    glb = glb_bytes(mesh, np.eye(4))
    tree, _ = _chunks(glb)
    (primitive,) = tree["meshes"][0]["primitives"]
    assert set(primitive["attributes"]) == {"POSITION", "NORMAL", "COLOR_0"}
    material = tree["materials"][primitive["material"]]["pbrMetallicRoughness"]
    assert material["metallicFactor"] == 0.0
    assert material.get("baseColorFactor", [1, 1, 1, 1]) == [1, 1, 1, 1]
    x, y, z = mesh.vertices.T
    np.testing.assert_array_equal(
        _accessor(glb, primitive["attributes"]["POSITION"]), np.stack([x, z, -y], 1)
    )
    linear = _accessor(glb, primitive["attributes"]["COLOR_0"])
    assert np.abs(srgb_from_linear(linear) - mesh.colors).max() < 0.1 / 255
    normals = _accessor(glb, primitive["attributes"]["NORMAL"])
    assert (normals * np.stack([x, z, -y], 1)).sum(1).min() > 0.0
    assert glb == glb_bytes(mesh, np.eye(4))


def test_glb_round_trip_through_trimesh(mesh: SurfaceMesh) -> None:
    T_objmesh_from_canonical = np.diag([0.12, 0.12, 0.12, 1.0])
    T_objmesh_from_canonical[:3, 3] = 0.01, -0.02, 0.03
    glb = glb_bytes(mesh, T_objmesh_from_canonical)
    (loaded,) = trimesh.load_scene(io.BytesIO(glb), file_type="glb", process=False).geometry.values()
    assert loaded.is_watertight
    assert loaded.volume == pytest.approx(
        0.12**3 * trimesh.Trimesh(mesh.vertices, mesh.faces).volume, rel=1e-5
    )
    np.testing.assert_array_equal(loaded.faces, mesh.faces)
    x, y, z = (0.12 * mesh.vertices + T_objmesh_from_canonical[:3, 3]).T
    np.testing.assert_allclose(loaded.vertices, np.stack([x, z, -y], 1), atol=1e-7)
    linear = np.asarray(loaded.visual.vertex_attributes["color"], dtype=np.float32)[:, :3]
    assert np.abs(srgb_from_linear(linear) - mesh.colors).max() < 1 / 255


def test_voxels_show_their_bare_sides_only() -> None:
    voxels = np.array([[0, 0, 0], [1, 0, 0], [5, 6, 7]])
    colors = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float32)
    mesh = voxel_mesh(voxels, 8, colors)
    assert len(mesh.faces) == 2 * (10 + 6)
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces)  # merges equal corners
    assert shape.is_watertight
    assert shape.volume == pytest.approx(3 / 8**3)
    centers = mesh.vertices[mesh.faces].mean(1)
    blue = mesh.colors[mesh.faces[:, 0]][:, 2] == 1.0
    assert np.abs(centers[blue] - (np.array([5, 6, 7]) + 0.5) / 8 + 0.5).max() <= 0.5 / 8 + 1e-6


def test_voxels_ply_round_trip() -> None:
    rng = np.random.default_rng(0)
    voxels = np.unique(rng.integers(0, 64, (500, 3)), axis=0)
    colors = rng.random((len(voxels), 3)).astype(np.float32)
    mesh = voxel_mesh(voxels, 64, colors)
    loaded = trimesh.load_mesh(io.BytesIO(voxels_ply(voxels, 64, colors)), file_type="ply", process=False)
    np.testing.assert_allclose(loaded.vertices, mesh.vertices, atol=1e-7)
    np.testing.assert_array_equal(loaded.faces, mesh.faces)
    assert np.abs(loaded.visual.vertex_colors[:, :3] / 255.0 - mesh.colors).max() <= 0.5 / 255 + 1e-6
