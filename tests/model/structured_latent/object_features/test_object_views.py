"""Images of clean objects: their colours, cameras and mirror images against a ball in closed form."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from model.errors import ModelError
from model.structured_latent.object_features.object_mesh import ObjectMeshes, textured_mesh
from model.structured_latent.object_features.object_views import (
    AMBIENT,
    RADIUS,
    REFLECTANCE,
    ObjectView,
    object_views,
    sphere_cameras,
)
from shards.color import linear_from_srgb, srgb_from_linear
from shards.errors import DatasetNotFoundError
from shards.geometry import camera_center, pixel_rays_cam
from shards.reader import open_dataset
from tests.model.data.balls import uid_of_split
from tests.model.structured_latent.object_features.textured_ball import (
    CENTER_OBJ,
    FACTOR,
    ball_colors,
    ball_glb,
    write_textured_balls,
)
from tests.shards.synthetic import RADIUS_M

SIZE = 96
T_OBJ_FROM_CANONICAL = np.diag([2 * RADIUS_M] * 3 + [1.0])
T_OBJ_FROM_CANONICAL[:3, 3] = CENTER_OBJ


def as_glb(shape: trimesh.Trimesh | trimesh.Scene) -> bytes:
    exported = shape.export(file_type="glb")
    assert isinstance(exported, bytes)
    return exported


def expected_image(view: ObjectView, *, mirror: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """sRGB 0..1 of the ball of radius 1/2 by intersecting rays, and where it is hit well inside."""
    center = camera_center(view.T_cam_from_canonical)
    rays = pixel_rays_cam(view.K, (SIZE, SIZE)) @ view.T_cam_from_canonical[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    along = -(rays @ center)
    root = along**2 - (center @ center - 0.25)
    points = center + (along - np.sqrt(np.maximum(root, 0)))[..., None] * rays
    normals = points / 0.5
    facing = np.abs((normals * rays).sum(-1))
    texture = linear_from_srgb(ball_colors(normals * [mirror, 1, 1])) * FACTOR
    light = AMBIENT + (1 - AMBIENT) * facing
    return srgb_from_linear((REFLECTANCE + (1 - REFLECTANCE) * texture) * light[..., None]), root > 0.02


def test_images_are_those_of_the_ball() -> None:
    mesh = textured_mesh(ball_glb(), T_OBJ_FROM_CANONICAL, where="ball")
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.5, atol=1e-5)
    for view in object_views(mesh, 5, SIZE, 2):
        for shown, mirror in ((view, 1.0), (view.mirrored(), -1.0)):
            expected, inside = expected_image(shown, mirror=mirror)
            difference = np.abs(shown.image / 255 - expected)[inside]
            assert inside.sum() > 2000
            assert difference.max() < 0.03
            assert difference.mean() < 0.004
        again = view.mirrored().mirrored()
        np.testing.assert_array_equal(again.image, view.image)
        np.testing.assert_allclose(again.T_cam_from_canonical, view.T_cam_from_canonical)
        assert (view.image[0] == 0).all()  # black beside the object


def test_a_texture_finer_than_the_pixels_is_averaged() -> None:
    """Black and white texels, 40 to a pixel: grey of half the light, without moiré."""
    checks = (255 * (np.indices((2048, 2048)).sum(0) % 2)).astype(np.uint8)
    corners = np.array([[-0.5, 0, -0.5], [0.5, 0, -0.5], [0.5, 0, 0.5], [-0.5, 0, 0.5]])
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(checks).convert("RGB"))
    board = trimesh.Trimesh(
        vertices=corners,
        faces=[[0, 1, 2], [0, 2, 3]],
        visual=trimesh.visual.TextureVisuals(uv=corners[:, ::2] + 0.5, material=material),
        process=False,
    )
    mesh = textured_mesh(as_glb(board), np.eye(4), where="board")
    for view in object_views(mesh, 3, SIZE, 1):
        shown = view.image[view.image.any(-1)]
        assert len(shown) > 200
        assert np.ptp(shown[:, 0].astype(int)) <= 40  # light alone varies


def test_colours_of_parts_are_kept_apart() -> None:
    """A red part moved by its node, and one with colours at its vertices."""
    red = trimesh.creation.box((0.4, 0.4, 0.4))
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[255, 0, 0, 255])
    red.visual = trimesh.visual.TextureVisuals(material=material)
    green = trimesh.creation.box((0.4, 0.4, 0.4))
    green.visual.vertex_colors = [0, 255, 0, 255]
    scene = trimesh.Scene()
    scene.add_geometry(red, transform=trimesh.transformations.translation_matrix([0, 1.0, 0]))
    scene.add_geometry(green)
    mesh = textured_mesh(as_glb(scene), np.diag([2.0, 2, 2, 1]), where="parts")
    up = mesh.vertices[:, 2] > 0.2  # glTF's Y is up; half the size in canonical units
    np.testing.assert_allclose(mesh.vertices[up].mean(0), [0, 0, 0.5], atol=1e-6)
    np.testing.assert_array_equal(mesh.colors[up], np.tile(np.array([1, 0, 0], np.float32), (up.sum(), 1)))
    np.testing.assert_array_equal(
        mesh.colors[~up], np.tile(np.array([0, 1, 0], np.float32), ((~up).sum(), 1))
    )


def test_cameras_look_at_the_object_from_all_sides() -> None:
    cameras = sphere_cameras(150)
    centers = camera_center(cameras)
    np.testing.assert_allclose(np.linalg.norm(centers, axis=1), RADIUS)
    np.testing.assert_allclose(cameras[:, :3, 3], np.tile([0, 0, RADIUS], (150, 1)), atol=1e-9)
    above = (centers[:, 2] > 0).mean()
    assert 0.74 < above < 0.76  # TRELLIS's remap
    spacing = np.linalg.norm(centers[:, None] - centers[None], axis=2) + 9 * np.eye(150)
    assert spacing.min() > 0.05
    everywhere = np.random.default_rng(0).standard_normal((500, 3))
    everywhere *= RADIUS / np.linalg.norm(everywhere, axis=1, keepdims=True)
    assert np.linalg.norm(everywhere[:, None] - centers[None], axis=2).min(1).max() < 0.9
    assert np.isfinite(sphere_cameras(1)).all()


@pytest.mark.parametrize("glb", [b"glTF", b"", ball_glb(steps=4)[:-500]])
def test_a_broken_mesh_is_one_line_that_names_the_object(glb: bytes) -> None:
    with pytest.raises(ModelError, match="shard 0, ball: its mesh cannot be read") as caught:
        textured_mesh(glb, np.eye(4), where="shard 0, ball")
    assert "\n" not in str(caught.value)


def test_a_mesh_without_triangles_is_refused() -> None:
    cloud = trimesh.Scene(trimesh.PointCloud([[0.0, 0, 0], [1, 0, 0]]))
    with pytest.raises(ModelError, match="cannot be read"):
        textured_mesh(as_glb(cloud), np.eye(4), where="cloud")


def test_meshes_are_found_by_name_in_any_shard(tmp_path: Path) -> None:
    meshes = ObjectMeshes(shards=open_dataset(str(write_textured_balls(tmp_path / "balls"))).shards)
    for uid in (uid_of_split("val", 0), uid_of_split("train", 0), uid_of_split("train", 2)):
        record = meshes.record(uid)
        assert record.object_uid == uid
        assert len(record.read().faces) > 1000
    with pytest.raises(DatasetNotFoundError, match="no-such-ball"):
        meshes.record("no-such-ball")


def test_an_object_whose_mesh_may_not_be_copied_says_so(tmp_path: Path) -> None:
    root = write_textured_balls(tmp_path / "balls", with_meshes=False)
    meshes = ObjectMeshes(shards=open_dataset(str(root)).shards)
    record = meshes.record(uid_of_split("train", 0))
    with pytest.raises(ModelError, match="its licence forbids copies"):
        record.read()
