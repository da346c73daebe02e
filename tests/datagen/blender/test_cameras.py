"""What Blender sees through an OpenCV camera, held against shards.geometry to a fraction of a pixel."""

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from datagen.blender.axes import blender_lens, world_from_blender_camera
from datagen.scene.table_mesh import inside_flat_top, table_from_world
from shards.geometry import (
    invert_transform,
    look_at,
    pixel_centers,
    project_points,
    transform_points,
    unproject_depth,
)
from tests.datagen.scene.boxes import OBJECT_HALF_M

OBJECT, HAND, ARM, TABLE = 1, 2, 3, 4


@pytest.fixture(scope="module")
def passes(render, box_scene, tmp_path_factory):
    """(camera, frame) -> (depth, index) of Cycles, one sample at every pixel centre."""
    frames_dir = tmp_path_factory.mktemp("passes") / "frames"
    done = render(box_scene, frames_dir, "--passes")
    assert done.status == 0, done.stderr
    read = {}
    for event in done.events:
        with OpenEXR.File(str(frames_dir / event["path"])) as file:
            channels = file.channels()
            depth = channels["ViewLayer.Depth.Z"].pixels.astype(np.float64)
            read[event["camera"], event["frame"]] = (
                depth,
                channels["ViewLayer.IndexMA.X"].pixels.round().astype(int),
            )
    assert len(read) == 4
    return read


@pytest.mark.blender
def test_every_pixel_centre_unprojects_onto_the_surface_it_shows(passes, box_scene):
    scene = box_scene
    n_seen = {HAND: 0, ARM: 0}
    for (c, frame), (depth, index) in passes.items():
        camera = scene.cameras[c]
        T_world_from_cam = invert_transform(camera.T_cam_from_world[frame])
        points_cam = unproject_depth(np.where(index > 0, depth, 0.0), camera.K)
        points_world = transform_points(T_world_from_cam, points_cam.reshape(-1, 3)).reshape(points_cam.shape)
        T_obj_from_world = invert_transform(scene.T_world_from_obj[frame])
        points_obj = transform_points(T_obj_from_world, points_world[index == OBJECT])
        assert len(points_obj) > 300
        # On a box the largest coordinate, in half sides, is 1: true for z-depth, false for distance.
        np.testing.assert_allclose(np.max(np.abs(points_obj) / OBJECT_HALF_M, axis=1), 1.0, atol=1e-3)
        on_table = points_world[index == TABLE]
        R_t = table_from_world(scene.table)
        x_table, y_table = R_t[:, :2] @ on_table[:, :2].T + R_t[:, 2:]
        flat = inside_flat_top(scene.table, x_table, y_table)
        above = on_table[flat & (on_table[:, 2] > scene.table.top_z_m - 0.01)]
        assert len(above) > 300
        np.testing.assert_allclose(above[:, 2], scene.table.top_z_m, atol=2e-5)
        # The arm lies along x: hand to 0.06, forearm and sleeve (both 3) from there to 0.22.
        for part, low, high in ((HAND, -0.02, 0.06), (ARM, 0.06, 0.22)):
            along = points_world[index == part][:, 0] - 0.03 * frame
            n_seen[part] += len(along)
            assert np.all((along > low - 1e-4) & (along < high + 1e-4))
    assert min(n_seen.values()) > 100


@pytest.mark.blender
def test_silhouettes_are_the_projected_outlines(passes, box_scene):
    for (c, frame), (_, index) in passes.items():
        camera = box_scene.cameras[c]
        T_cam_from_obj = camera.T_cam_from_world[frame] @ box_scene.T_world_from_obj[frame]
        corners = transform_points(T_cam_from_obj, box_scene.object_mesh.verts_obj)
        hull = cv2.convexHull(project_points(corners, camera.K).astype(np.float32))
        centers = pixel_centers(camera.image_size).reshape(-1, 2)
        inside_px = np.array([cv2.pointPolygonTest(hull, (float(u), float(v)), True) for u, v in centers])
        inside_px = inside_px.reshape(index.shape)
        assert np.isin(index[inside_px > 0.02], (OBJECT, HAND, ARM)).all()
        assert not (index[inside_px < -0.02] == OBJECT).any()


@pytest.mark.blender
def test_images_agree_with_masks_to_a_tenth_of_a_pixel(render, emissive_scene, tmp_path):
    scene = emissive_scene
    done = render(scene, tmp_path / "glow")
    assert done.status == 0, done.stderr
    for event in [e for e in done.events if e["event"] == "frame"]:
        camera = scene.cameras[event["camera"]]
        image = np.asarray(Image.open(tmp_path / "glow" / event["path"]), np.float64)[..., 0] / 255.0
        linear = np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)
        T_cam_from_obj = camera.T_cam_from_world[event["frame"]] @ scene.T_world_from_obj[event["frame"]]
        outline = project_points(transform_points(T_cam_from_obj, scene.object_mesh.verts_obj), camera.K)
        moments = cv2.moments(cv2.convexHull(outline.astype(np.float32)))
        expected = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
        seen = np.average(pixel_centers(camera.image_size).reshape(-1, 2), axis=0, weights=linear.reshape(-1))
        assert np.abs(seen - expected).max() < 0.1


def test_blender_axes_turn_half_way_about_x():
    T_cam_from_world = look_at(np.array([1.0, 2.0, 3.0]), np.zeros(3))
    T_world_from_blender = world_from_blender_camera(T_cam_from_world)
    forward, up = -T_world_from_blender[:3, 2], T_world_from_blender[:3, 1]
    np.testing.assert_allclose(forward, -np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0), atol=1e-12)
    assert up[2] > 0.0


def test_a_centred_square_pixel_needs_no_shift():
    lens = blender_lens(np.array([[100.0, 0.0, 50.0], [0.0, 100.0, 30.0], [0.0, 0.0, 1.0]]), (100, 60))
    assert (lens.shift_x, lens.shift_y, lens.pixel_aspect_x, lens.pixel_aspect_y) == (0.0, 0.0, 1.0, 1.0)
    assert lens.focal_mm == 36.0


@pytest.mark.parametrize(
    ("K", "says"),
    [
        ([[100.0, 3.0, 50.0], [0.0, 100.0, 30.0], [0.0, 0.0, 1.0]], "K must be"),
        ([[0.0, 0.0, 50.0], [0.0, 100.0, 30.0], [0.0, 0.0, 1.0]], "positive focal"),
    ],
)
def test_cameras_blender_cannot_have_are_refused(K, says):
    with pytest.raises(ValueError, match=says):
        blender_lens(np.array(K), (100, 60))
