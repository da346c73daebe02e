"""A small Scene of boxes, whose planes say exactly what every pixel must see."""

import io

import numpy as np
from PIL import Image

from datagen.objects.mesh.object_mesh import Material, ObjectMesh
from datagen.scene.scene import (
    ARM_SKIN,
    HAND_SKIN,
    SLEEVE,
    AreaLight,
    Background,
    CameraPath,
    HandLook,
    HandSurface,
    RenderSettings,
    Scene,
    Table,
)
from shards.geometry import look_at

__all__ = ["OBJECT_HALF_M", "made_box_scene", "made_png"]

OBJECT_HALF_M = np.array([0.05, 0.03, 0.08])
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
_QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
_FACES = np.array([t for a, b, c, d in _QUADS for t in ((a, b, c), (a, c, d))])


def made_box_scene() -> Scene:
    """Two frames, two cameras with every freedom of K: off-centre, oblong pixels, oblong image, roll."""
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    T_world_from_obj = np.tile(np.eye(4), (2, 1, 1))
    T_world_from_obj[:, :3, :3] = turn
    T_world_from_obj[1, :3, 3] = [0.03, -0.02, 0.05]
    hand, surface = _hand()
    hand_verts_world = np.stack([hand, hand + np.array([0.03, -0.02, 0.05])])
    cameras = tuple(
        CameraPath(
            kind="orbit",
            K=K,
            image_size=size,
            T_cam_from_world=look_at(
                np.array([center, np.add(center, 0.02)]),
                np.array([[0.02, 0.0, 0.03]] * 2),
                roll_rad=np.array([roll, roll]),
            ),
        )
        for K, size, center, roll in (
            (
                np.array([[90.0, 0.0, 40.0], [0.0, 110.0, 41.0], [0.0, 0.0, 1.0]]),
                (96, 72),
                (0.4, -0.4, 0.35),
                0.2,
            ),
            (
                np.array([[130.0, 0.0, 38.5], [0.0, 105.0, 40.0], [0.0, 0.0, 1.0]]),
                (64, 96),
                (-0.5, -0.3, 0.2),
                -0.4,
            ),
        )
    )
    return Scene(
        motion_id="boxes",
        fps=10.0,
        object_uid="box",
        object_mesh=ObjectMesh(
            verts_obj=_CORNERS * OBJECT_HALF_M,
            faces=_FACES,
            corner_uv=np.zeros((12, 3, 2)),
            face_material=np.zeros(12, int),
            materials=(
                Material(
                    name="paint",
                    base_color_rgba=(0.2, 0.3, 0.6, 1.0),
                    base_color_image=made_png((90, 120, 200)),
                ),
            ),
        ),
        T_world_from_obj=T_world_from_obj,
        hand_surface=surface,
        hand_verts_world=hand_verts_world,
        hand_look=HandLook(
            skin_png=made_png((210, 160, 130)),
            skin_coefficients=np.zeros(3),
            skin_roughness=0.45,
            subsurface=0.3,
            bump=0.5,
            nail_gloss=0.5,
            sleeve_color_rgb=(0.1, 0.1, 0.3),
            sleeve_weave=1.0,
            nail_mask_png=made_png((0, 0, 0)),
        ),
        cameras=cameras,
        lights=(
            AreaLight(
                position_world=np.array([0.5, 0.2, 1.0]),
                target_world=np.zeros(3),
                power_w=8.0,
                size_m=0.3,
                color_rgb=(1.0, 0.9, 0.8),
            ),
        ),
        background=Background(hdri="studio", rotation_rad=0.4, strength=0.7),
        table=Table(
            top_z_m=-0.08,
            center_xy_m=(0.0, 0.05),
            size_xy_m=(0.5, 0.4),
            thickness_m=0.03,
            yaw_rad=0.3,
            material="wood",
            color_a_rgb=(0.1, 0.05, 0.02),
            color_b_rgb=(0.4, 0.2, 0.1),
            pattern_scale=1.0,
            roughness=0.4,
            pattern_seed=3,
        ),
        render=RenderSettings(samples=4, max_bounces=3, denoise=True, exposure_ev=0.0, view_transform="AgX"),
        seed=5,
    )


def made_png(color: tuple[int, int, int]) -> bytes:
    """A flat colour with a little texture."""
    pixels = np.full((16, 16, 3), color, np.uint8)
    pixels[::4] = pixels[::4] * 0.9
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()


def _hand() -> tuple[np.ndarray, HandSurface]:
    """Three boxes in a row, each sharing four vertices with the next: hand, forearm, sleeve."""
    corners = _CORNERS[[0, 2, 3, 1]] * [0.0, 0.02, 0.02]  # a square in the plane x = 0
    verts = np.concatenate([corners + np.array([x, 0.0, 0.11]) for x in (-0.02, 0.06, 0.13, 0.22)])
    ring = np.array([(a, b, b + 4, a + 4) for a, b in ((0, 1), (1, 2), (2, 3), (3, 0))])
    quads = np.concatenate([ring, ring + 4, ring + 8, [[3, 2, 1, 0], [12, 13, 14, 15]]])
    parts = np.array([HAND_SKIN] * 4 + [ARM_SKIN] * 4 + [SLEEVE] * 4 + [HAND_SKIN, SLEEVE])
    uv = np.array([[0.1, 0.1], [0.1, 0.9], [0.9, 0.9], [0.9, 0.1]])
    halves = np.array([[0, 1, 2], [0, 2, 3]])
    surface = HandSurface(
        faces=quads[:, halves].reshape(-1, 3),
        corner_uv=np.tile(uv[halves], (len(quads), 1, 1)),
        face_part=np.repeat(parts, 2),
        n_hand_verts=8,
    )
    return verts, surface
