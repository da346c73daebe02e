"""Small scenes whose geometry buffers are tested: a body, a rod for a hand or a posed hand, a table, cameras."""

from dataclasses import replace
from typing import Any

import numpy as np
import trimesh

from datagen.hands.arm import ArmStyle, dress_hand, dressed_verts
from datagen.hands.model import load_open_hand, pose_hand, shape_hand
from datagen.hands.skin import decode_skin, load_open_skin, open_nail_mask_png
from datagen.objects.mesh.object_mesh import Material, ObjectMesh
from datagen.scene.scene import (
    ARM_SKIN,
    HAND_SKIN,
    AreaLight,
    Background,
    CameraPath,
    HandLook,
    HandSurface,
    RenderSettings,
    Scene,
    Table,
)
from shards.geometry import (
    intrinsics_from_fov,
    look_at,
)
from shards.storage.png import encode_png

SIZE = (160, 120)
K = intrinsics_from_fov(np.radians(45.0), SIZE)
TABLE = Table(
    top_z_m=0.1,
    center_xy_m=(0.03, -0.02),
    size_xy_m=(0.5, 0.4),
    thickness_m=0.03,
    yaw_rad=0.4,
    material="wood",
    color_a_rgb=(0.2, 0.1, 0.05),
    color_b_rgb=(0.4, 0.2, 0.1),
    pattern_scale=1.0,
    roughness=0.5,
    pattern_seed=1,
)


def object_mesh(mesh: trimesh.Trimesh, smooth: bool = True) -> ObjectMesh:
    return ObjectMesh(
        verts_obj=np.array(mesh.vertices, float),
        faces=np.array(mesh.faces, int),
        corner_uv=np.zeros((len(mesh.faces), 3, 2)),
        face_material=np.zeros(len(mesh.faces), int),
        materials=(Material(name="plain", base_color_rgba=(0.5, 0.4, 0.3, 1.0)),),
        smooth=smooth,
    )


def make_scene(
    obj: trimesh.Trimesh,
    *,
    n_frames: int = 2,
    table: Table | None = TABLE,
    eyes: tuple[tuple[float, float, float], ...] = ((0.55, 0.1, 0.45), (-0.2, -0.5, 0.3)),
    size: tuple[int, int] = SIZE,
) -> Scene:
    """An object between a bumpy palm (hand) and a rod (arm), above a table, turning from frame to frame."""
    palm = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    palm.vertices *= np.array([0.5, 1.0, 0.8]) * (1.0 + 0.1 * np.sin(80.0 * palm.vertices[:, :1]))
    palm.apply_translation([0.08, 0.02, 0.24])
    rod = trimesh.creation.cylinder(radius=0.03, height=0.25, sections=24)
    rod.apply_transform(trimesh.transformations.rotation_matrix(1.2, [0.0, 1.0, 0.0]))
    rod.apply_translation([0.22, 0.03, 0.3])
    n_hand = len(palm.vertices)
    faces = np.concatenate([palm.faces, rod.faces + n_hand])
    verts = np.concatenate([palm.vertices, rod.vertices])
    T = np.stack([trimesh.transformations.rotation_matrix(0.4 * t, [0.3, 0.5, 1.0]) for t in range(n_frames)])
    T[:, :3, 3] = [[0.0, 0.0, 0.22 + 0.01 * t] for t in range(n_frames)]
    fov_K = intrinsics_from_fov(np.radians(45.0), size)
    target = np.array([0.05, 0.0, 0.2])
    return Scene(
        motion_id="motion",
        fps=10.0,
        object_uid="object",
        object_mesh=object_mesh(obj),
        T_world_from_obj=T,
        hand_surface=HandSurface(
            faces=faces,
            corner_uv=np.tile(np.array([[0.4, 0.4], [0.6, 0.4], [0.5, 0.6]]), (len(faces), 1, 1)),
            face_part=np.where(np.arange(len(faces)) < len(palm.faces), HAND_SKIN, ARM_SKIN),
            n_hand_verts=n_hand,
        ),
        hand_verts_world=np.stack([verts + np.array([0.0, 0.0, 0.01 * t]) for t in range(n_frames)]),
        hand_look=HandLook(
            skin_png=encode_png(np.full((8, 8, 3), 160, np.uint8)),
            skin_coefficients=np.zeros(2),
            skin_roughness=0.5,
            subsurface=0.0,
            bump=0.1,
            nail_gloss=0.0,
            sleeve_color_rgb=(0.1, 0.1, 0.3),
            sleeve_weave=1.0,
        ),
        cameras=tuple(
            CameraPath(
                kind="orbit",
                K=fov_K,
                image_size=size,
                T_cam_from_world=np.stack([look_at(np.array(eye), target, 0.1)] * n_frames),
            )
            for eye in eyes
        ),
        lights=(
            AreaLight(
                position_world=np.array([0.5, 0.5, 1.2]),
                target_world=target,
                power_w=8.0,
                size_m=0.3,
                color_rgb=(1.0, 1.0, 1.0),
            ),
        ),
        background=Background(hdri="studio", rotation_rad=0.0, strength=0.5),
        table=table,
        render=RenderSettings(samples=1, max_bounces=1, denoise=False, exposure_ev=0.0, view_transform="AgX"),
        seed=3,
    )


def make_hand_scene(size: tuple[int, int]) -> tuple[Scene, np.ndarray]:
    """The open hand with forearm and sleeve over a bumpy ball, and its 21 joints per frame."""
    scene = make_scene(bumpy_ball(), size=size)
    hand = shape_hand(load_open_hand(), np.zeros(10))
    style = ArmStyle(
        length_m=0.2,
        girth=1.0,
        sleeve_start_m=0.06,
        sleeve_gap_m=0.005,
        cuff_m=0.03,
        fold_depth_m=0.002,
        fold_phase_rad=0.5,
    )
    dressed = dress_hand(hand, style)
    turn = np.array([[1.3, 0.2, 0.1], [1.4, 0.1, 0.2]])
    at_origin: dict[str, Any] = {
        "orientation_world": turn,
        "hand_pose": np.full((2, 45), 0.05),
        "flat_hand_mean": True,
    }
    rest = pose_hand(hand, translation_world=np.zeros((2, 3)), **at_origin)
    beside = np.array([0.04, 0.0, 0.28]) - rest.joints_world[:, 4]
    posed = pose_hand(hand, translation_world=beside, **at_origin)
    skins = load_open_skin()
    scene = replace(
        scene,
        hand_surface=HandSurface(
            faces=dressed.faces,
            corner_uv=dressed.corner_uv,
            face_part=dressed.face_part,
            n_hand_verts=dressed.n_hand_verts,
        ),
        hand_verts_world=dressed_verts(dressed, posed),
        hand_look=replace(
            scene.hand_look,
            skin_png=encode_png(decode_skin(skins, np.zeros(skins.basis.shape[1])), level=1),
            skin_coefficients=np.zeros(skins.basis.shape[1]),
            nail_mask_png=open_nail_mask_png(),
        ),
    )
    return scene, posed.joints_world


def bumpy_ball() -> trimesh.Trimesh:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.06)
    ball.vertices *= 1.0 + 0.15 * np.sin(60.0 * ball.vertices[:, 1:2])
    return ball
