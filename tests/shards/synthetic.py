"""A small motion that is right in every number: a ball held by a ball, seen by orbiting cameras.

Everything is analytic (two spheres), so masks, depth, boxes and joints agree exactly and the
verifier must accept it. No randomness but the seed given.
"""

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from shards.geometry import (
    intrinsics_from_fov,
    look_at,
    pixel_rays_cam,
    project_points,
    transform_points,
)
from shards.schema import CONVENTIONS, SCHEMA_VERSION, ClipRow, FrameRow, ObjectRow
from shards.splits import SplitRule, split_of_object
from shards.storage.images import MASK_BITS, encode_geometry, encode_masks, encode_rgb_png, mask_box_px
from shards.storage.records import DatasetRecord, MotionRecord, Provenance
from shards.writer import begin_dataset, commit_shard, stage_motion

PROVENANCE = Provenance(generator_commit="0" * 40, config_sha256=hashlib.sha256(b"config").hexdigest())
SPLIT_RULE = SplitRule(val_fraction=0.2, test_fraction=0.2)
RADIUS_M = 0.04


def synthetic_dataset(
    root: Path, *, motions: int = 2, cameras: int = 2, n_frames: int = 3, size_px: int = 40
) -> Path:
    """A committed dataset of one shard."""
    begin_dataset(root, dataset_record())
    for motion_index in range(motions):
        stage_synthetic(root, motion_index, cameras=cameras, n_frames=n_frames, size_px=size_px)
    commit_shard(root, 0, motion_indices=range(motions), provenance=PROVENANCE)
    return root


def dataset_record() -> DatasetRecord:
    return DatasetRecord(
        schema_version=SCHEMA_VERSION,
        name="two balls",
        conventions=CONVENTIONS,
        provenance=PROVENANCE,
        config_yaml="motions: 2\n",
        split_rule=SPLIT_RULE,
    )


def stage_synthetic(
    root: Path,
    motion_index: int,
    *,
    cameras: int = 2,
    n_frames: int = 3,
    size_px: int = 40,
    change_frame: Callable[[FrameRow], FrameRow] = lambda frame: frame,
) -> MotionRecord:
    object_row = synthetic_object(motion_index % 2)
    clips: list[ClipRow] = []
    frames: list[FrameRow] = []
    for camera_index in range(cameras):
        clip, clip_frames = synthetic_clip(object_row, motion_index, camera_index, n_frames, size_px)
        clips.append(clip)
        frames.extend(change_frame(frame) for frame in clip_frames)
    return stage_motion(
        root,
        0,
        motion_index,
        object_row=object_row,
        clips=clips,
        frames=frames,
        timings_s={"render": 1.5},
        provenance=PROVENANCE,
    )


def synthetic_object(number: int, *, mesh: bool = True) -> ObjectRow:
    """A ball of RADIUS_M around (0.01, 0, 0) in its own frame."""
    rng = np.random.default_rng(number)
    normals = rng.normal(size=(400, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    centers = (np.stack(np.meshgrid(*[np.arange(64)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.5) / 64 - 0.5
    occupied = (
        np.abs(np.linalg.norm(centers, axis=1) - 0.5) <= np.sqrt(3.0) / 128
    )  # all voxels the sphere cuts
    voxels = np.floor((centers[occupied] + 0.5) * 64).astype(np.uint8)
    samples = rng.uniform(-0.5, 0.5, (300, 3))
    T = np.diag([2 * RADIUS_M] * 3 + [1.0])
    T[:3, 3] = [0.01, 0.0, 0.0]
    glb = b"glTF" + bytes(rng.integers(0, 256, 3000, dtype=np.uint8))
    return ObjectRow(
        object_uid=f"ball-{number}",
        name="ball",
        source="synthetic",
        licence="CC0-1.0",
        author="nobody",
        url="",
        mesh_glb=glb if mesh else None,
        mesh_sha256=hashlib.sha256(glb).hexdigest(),
        object_scale_m=2 * RADIUS_M,
        catalogue_scale=1.0,
        T_objmesh_from_canonical=T,
        occupancy_64=voxels,
        surface_points=0.5 * normals,
        surface_normals=normals,
        surface_colors=rng.integers(0, 256, (400, 3), dtype=np.uint8),
        sdf_points=samples,
        sdf_values=np.linalg.norm(samples, axis=1) - 0.5,
        texture_resolution_px=512,
        color_detail=0.5,
        appearance="original",
        registration_residual=float("nan"),
        watertight_source=True,
    )


def synthetic_clip(
    object_row: ObjectRow, motion_index: int, camera_index: int, n_frames: int, size_px: int
) -> tuple[ClipRow, list[FrameRow]]:
    clip_id = f"motion-{motion_index:06d}-camera-{camera_index:02d}"
    K = intrinsics_from_fov(0.7, (size_px, size_px))
    frames = [synthetic_frame(clip_id, i, motion_index, camera_index, K, size_px) for i in range(n_frames)]
    object_seen = [frame.object_visible_fraction for frame in frames]
    hand_seen = [frame.hand_visible_fraction for frame in frames]
    clip = ClipRow(
        clip_id=clip_id,
        motion_id=f"motion-{motion_index:06d}",
        motion_index=motion_index,
        camera_index=camera_index,
        object_uid=object_row.object_uid,
        split=split_of_object(object_row.object_uid, SPLIT_RULE),
        dataset_seed=7,
        n_frames=n_frames,
        fps=10.0,
        image_width=size_px,
        image_height=size_px,
        K=K,
        camera_kind="orbit",
        hand_model="openhand",
        hand_stands_in_for="",
        hand_side="right",
        flat_hand_mean=True,
        betas=np.zeros(10),
        skin_model="open",
        skin_coefficients=np.array([0.5, -0.5]),
        skin_roughness=0.5,
        skin_subsurface=0.1,
        skin_bump=0.2,
        nail_gloss=0.3,
        has_sleeve=False,
        sleeve_color_rgb=np.array([0.1, 0.2, 0.3]),
        grasp_source="synthesised",
        grasp_sequence_id=f"ball-{motion_index}",
        grasp_licence="",
        grasp_frame=0,
        rise_m=0.12,
        center_distance_m=0.05,
        max_penetration_m=float("nan"),
        digits_in_contact=3,
        slip_lift_m=0.001,
        slip_manipulation_m=0.002,
        digit_distance_m=np.zeros(5),
        grasp_attempts=2,
        light_position_world=np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]]),
        light_target_world=np.zeros((2, 3)),
        light_power_w=np.array([10.0, 20.0]),
        light_size_m=np.array([0.5, 0.6]),
        light_color_rgb=np.ones((2, 3)),
        hdri="studio",
        hdri_rotation_rad=0.1,
        hdri_strength=1.0,
        has_table=False,
        table_top_z_m=float("nan"),
        table_material="",
        object_visible_fraction_min=min(object_seen),
        object_visible_fraction_mean=float(np.mean(object_seen)),
        hand_visible_fraction_min=min(hand_seen),
        hand_visible_fraction_mean=float(np.mean(hand_seen)),
        object_drift_px=1.0,
        min_margin_px=2.0,
        render_engine="analytic",
        render_engine_version="1",
        render_device="CPU",
        render_samples=1,
        render_denoiser="none",
        render_view_transform="Standard",
        render_exposure_ev=0.0,
        render_seconds=0.5,
        rgb_codec="png",
    )
    return clip, frames


def synthetic_frame(
    clip_id: str, frame_index: int, motion_index: int, camera_index: int, K: np.ndarray, size_px: int
) -> FrameRow:
    angle = 0.4 * camera_index + 0.1 * frame_index + 0.3 * motion_index
    T_world_from_obj = np.eye(4)
    T_world_from_obj[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T_world_from_obj[:3, 3] = [0.0, 0.0, 0.01 * frame_index]
    center_world = np.array([0.6 * np.cos(2 * angle), 0.6 * np.sin(2 * angle), 0.3])
    T_cam_from_world = look_at(center_world, np.zeros(3))
    object_center_world = transform_points(T_world_from_obj, np.array([[0.01, 0.0, 0.0]]))[0]
    hand_center_world = object_center_world + 0.05 * (center_world / np.linalg.norm(center_world))
    hand_center_world[2] += 0.03
    arm_center_world = hand_center_world + np.array([0.0, 0.0, 0.07])

    rays = pixel_rays_cam(K, (size_px, size_px))
    surfaces = {
        name: _sphere_depth(rays, transform_points(T_cam_from_world, center[None])[0], radius)
        for name, center, radius in (
            ("object", object_center_world, RADIUS_M),
            ("hand", hand_center_world, 0.03),
            ("arm", arm_center_world, 0.02),
        )
    }
    first = np.min([np.where(d > 0, d, np.inf) for d, _ in surfaces.values()], axis=0)
    masks, normals = {}, np.zeros((size_px, size_px, 3))
    for name, (depth, normal) in surfaces.items():
        masks[f"{name}_amodal"] = depth > 0
        masks[f"{name}_visible"] = (depth > 0) & (depth == first)
        normals[masks[f"{name}_visible"]] = normal[masks[f"{name}_visible"]]
    geometry = encode_geometry(
        np.where(np.isfinite(first), first, 0.0), surfaces["object"][0], normals, compression="pxr24"
    )
    bits = np.sum([np.uint8(bit) * masks[name] for name, bit in MASK_BITS.items()], axis=0, dtype=np.uint8)
    rgb = np.clip(127.5 * (normals + 1.0), 0, 255).astype(np.uint8)
    joints_world = hand_center_world + 0.02 * np.random.default_rng(3).normal(size=(21, 3))
    joints_world = joints_world.astype(np.float32)
    joints_cam = transform_points(T_cam_from_world, joints_world)
    counts = {name: int(np.count_nonzero(mask)) for name, mask in masks.items()}
    return FrameRow(
        clip_id=clip_id,
        frame_index=frame_index,
        time_s=frame_index / 10.0,
        T_cam_from_world=T_cam_from_world,
        T_world_from_obj=T_world_from_obj,
        hand_orientation_world=np.zeros(3),
        hand_pose=np.linspace(0.0, 1.0, 45),
        hand_translation_world=hand_center_world,
        joints_world=joints_world,
        joints_px=project_points(joints_cam, K),
        hand_box_visible_px=np.array(mask_box_px(masks["hand_visible"])),
        hand_box_amodal_px=np.array(mask_box_px(masks["hand_amodal"])),
        object_box_visible_px=np.array(mask_box_px(masks["object_visible"])),
        object_box_amodal_px=np.array(mask_box_px(masks["object_amodal"])),
        hand_pixels_visible=counts["hand_visible"],
        hand_pixels_amodal=counts["hand_amodal"],
        object_pixels_visible=counts["object_visible"],
        object_pixels_amodal=counts["object_amodal"],
        hand_visible_fraction=counts["hand_visible"] / max(1, counts["hand_amodal"]),
        object_visible_fraction=counts["object_visible"] / max(1, counts["object_amodal"]),
        contact_force_n=np.array([1.0, 0.5, 0.5, 0.0, 0.0]),
        hand_object_distance_m=-0.001,
        rgb=encode_rgb_png(rgb),
        masks=encode_masks(bits),
        geometry=geometry,
    )


def _sphere_depth(
    rays_cam: np.ndarray, center_cam: np.ndarray, radius_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """z of the first hit of each ray (z = 1 directions) and the outward normal; 0 where missed."""
    a = np.sum(rays_cam**2, axis=-1)
    b = rays_cam @ center_cam
    root = b**2 - a * (center_cam @ center_cam - radius_m**2)
    depth = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0.0))) / a, 0.0)
    normal = (rays_cam * depth[..., None] - center_cam) / radius_m
    return depth, np.where(depth[..., None] > 0, normal, 0.0)


__all__ = [
    "PROVENANCE",
    "SPLIT_RULE",
    "dataset_record",
    "stage_synthetic",
    "synthetic_clip",
    "synthetic_dataset",
    "synthetic_object",
]
