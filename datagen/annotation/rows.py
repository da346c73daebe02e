"""Scene + rendered frames + annotations -> shard rows."""

import hashlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from PIL import Image

from datagen.annotation.annotate import FrameGeometry
from datagen.objects.asset.object_asset import ObjectAsset
from datagen.objects.formats.glb_export import mesh_to_glb
from datagen.objects.targets.learning_targets import LearningTargets
from datagen.plan.plan import MotionPlan
from datagen.sampling.scene_sampling import SampledMotion
from datagen.scene.scene import SLEEVE
from shards.geometry import project_points, transform_points
from shards.schema import ClipRow, FrameRow, ObjectRow
from shards.settings import Range
from shards.storage.images import decode_rgb, encode_geometry, encode_masks, encode_rgb_png

__all__ = ["RenderRecord", "ShardConfig", "clip_id_of", "clip_row", "encoded_rgb", "frame_row", "object_row"]

# Licences that let us hand the mesh on; of all others the shard holds renders and targets only.
REDISTRIBUTABLE = ("CC0-1.0", "CC-BY-3.0", "CC-BY-4.0", "Apache-2.0", "MIT", "BSD-3-Clause")


@dataclass(frozen=True, kw_only=True)
class ShardConfig:
    """How arrays are stored (DECISIONS D1, D3)."""

    depth_compression: Literal["pxr24", "zip"]
    rgb_codec: Literal["png", "jpeg", "webp"]  # png needs nothing to read; the others need Pillow
    rgb_quality: Annotated[int, Range(1, 100)]  # 1..100, jpeg and webp only


@dataclass(frozen=True, kw_only=True)
class RenderRecord:
    """What the render child says about its work."""

    engine_version: str
    device: str
    denoiser: str
    seconds_per_camera: tuple[float, ...]


def clip_id_of(motion_id: str, camera_index: int) -> str:
    """`motion-000012` and camera 3 -> `motion-000012-cam-03`."""
    return f"{motion_id}-cam-{camera_index:02d}"


def encoded_rgb(png: bytes, config: ShardConfig) -> bytes:
    """A rendered PNG in the shard's codec. Blender's PNG is decoded once and packed again, smaller and reproducible."""
    pixels = decode_rgb(png)
    if config.rgb_codec == "png":
        return encode_rgb_png(pixels)
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, format=config.rgb_codec, quality=config.rgb_quality)
    return stream.getvalue()


def object_row(asset: ObjectAsset, targets: LearningTargets) -> ObjectRow:
    """The object as other labs get it: mesh where the licence allows it, and learning targets."""
    glb = mesh_to_glb(asset.mesh)
    return ObjectRow(
        object_uid=asset.uid,
        name=asset.name,
        source=asset.source,
        licence=asset.licence,
        author=asset.author,
        url=asset.url,
        mesh_glb=glb if set(asset.licence.split(" AND ")) <= set(REDISTRIBUTABLE) else None,
        mesh_sha256=hashlib.sha256(glb).hexdigest(),
        object_scale_m=targets.object_scale_m,
        catalogue_scale=asset.catalogue_scale,
        T_objmesh_from_canonical=targets.T_objmesh_from_canonical,
        occupancy_64=targets.occupancy_64,
        surface_points=targets.surface_points,
        surface_normals=targets.surface_normals,
        surface_colors=targets.surface_colors,
        sdf_points=targets.sdf_points,
        sdf_values=targets.sdf_values,
        texture_resolution_px=asset.texture.texture_resolution_px,
        color_detail=asset.texture.color_detail,
        appearance=asset.appearance,
        registration_residual=float("nan") if asset.registration is None else asset.registration.residual,
        watertight_source=asset.watertight.watertight_source,
    )


def clip_row(
    motion: MotionPlan,
    sampled: SampledMotion,
    camera_index: int,
    frames: Sequence[FrameRow],
    record: RenderRecord,
    config: ShardConfig,
    dataset_seed: int,
) -> ClipRow:
    """One camera of one motion; the quality metrics are those of its frames."""
    scene, sequence = sampled.scene, sampled.sequence
    camera, look, quality = scene.cameras[camera_index], scene.hand_look, sampled.sequence.quality
    metrics = sampled.camera_metrics[camera_index]
    object_visible = [frame.object_visible_fraction for frame in frames]
    hand_visible = [frame.hand_visible_fraction for frame in frames]
    lights, table = scene.lights, scene.table
    return ClipRow(
        clip_id=clip_id_of(motion.motion_id, camera_index),
        motion_id=motion.motion_id,
        motion_index=motion.motion_index,
        camera_index=camera_index,
        object_uid=motion.object_uid,
        split=motion.split,
        dataset_seed=dataset_seed,
        n_frames=len(frames),
        fps=scene.fps,
        image_width=camera.image_size[0],
        image_height=camera.image_size[1],
        K=camera.K,
        camera_kind=camera.kind,
        hand_model=sequence.hand_model,
        hand_stands_in_for=sequence.stands_in_for,
        hand_side=sequence.side,
        flat_hand_mean=sequence.flat_hand_mean,
        betas=sequence.betas,
        skin_model=sampled.skin_model,
        skin_coefficients=look.skin_coefficients,
        skin_roughness=look.skin_roughness,
        skin_subsurface=look.subsurface,
        skin_bump=look.bump,
        nail_gloss=look.nail_gloss,
        has_sleeve=bool(np.any(scene.hand_surface.face_part == SLEEVE)),
        sleeve_color_rgb=np.asarray(look.sleeve_color_rgb),
        grasp_source=sequence.source,
        grasp_sequence_id=sequence.sequence_id,
        grasp_licence=sequence.licence,
        grasp_frame=sampled.grasp_frame,
        rise_m=quality.rise_m,
        center_distance_m=quality.center_distance_m,
        max_penetration_m=quality.max_penetration_m,
        digits_in_contact=quality.digits_in_contact,
        slip_lift_m=quality.slip_lift_m,
        slip_manipulation_m=quality.slip_manipulation_m,
        digit_distance_m=quality.digit_distance_m,
        grasp_attempts=quality.attempts,
        light_position_world=np.array([light.position_world for light in lights]).reshape(-1, 3),
        light_target_world=np.array([light.target_world for light in lights]).reshape(-1, 3),
        light_power_w=np.array([light.power_w for light in lights]),
        light_size_m=np.array([light.size_m for light in lights]),
        light_color_rgb=np.array([light.color_rgb for light in lights]).reshape(-1, 3),
        hdri=scene.background.hdri,
        hdri_rotation_rad=scene.background.rotation_rad,
        hdri_strength=scene.background.strength,
        has_table=table is not None,
        table_top_z_m=float("nan") if table is None else table.top_z_m,
        table_material="" if table is None else table.material,
        object_visible_fraction_min=min(object_visible),
        object_visible_fraction_mean=float(np.mean(object_visible)),
        hand_visible_fraction_min=min(hand_visible),
        hand_visible_fraction_mean=float(np.mean(hand_visible)),
        object_drift_px=metrics.object_drift_px,
        min_margin_px=metrics.min_margin_px,
        render_engine="Cycles",
        render_engine_version=record.engine_version,
        render_device=record.device,
        render_samples=scene.render.samples,
        render_denoiser=record.denoiser,
        render_view_transform=scene.render.view_transform,
        render_exposure_ev=scene.render.exposure_ev,
        render_seconds=record.seconds_per_camera[camera_index],
        rgb_codec=config.rgb_codec,
    )


def frame_row(
    motion: MotionPlan,
    sampled: SampledMotion,
    camera_index: int,
    frame_index: int,
    geometry: FrameGeometry,
    hand_object_distance_m: float,
    rgb: bytes,
    config: ShardConfig,
) -> FrameRow:
    """One image with all that is known of it."""
    scene = sampled.scene
    camera = scene.cameras[camera_index]
    T_cam_from_world = camera.T_cam_from_world[frame_index]
    joints_world = sampled.joints_world[frame_index]
    hand, obj = geometry.hand, geometry.object
    return FrameRow(
        clip_id=clip_id_of(motion.motion_id, camera_index),
        frame_index=frame_index,
        time_s=frame_index / scene.fps,
        T_cam_from_world=T_cam_from_world,
        T_world_from_obj=scene.T_world_from_obj[frame_index],
        hand_orientation_world=sampled.hand_orientation_world[frame_index],
        hand_pose=sampled.hand_pose[frame_index],
        hand_translation_world=sampled.hand_translation_world[frame_index],
        joints_world=joints_world,
        joints_px=project_points(transform_points(T_cam_from_world, joints_world), camera.K),
        hand_box_visible_px=hand.box_visible_px,
        hand_box_amodal_px=hand.box_amodal_px,
        object_box_visible_px=obj.box_visible_px,
        object_box_amodal_px=obj.box_amodal_px,
        hand_pixels_visible=hand.pixels_visible,
        hand_pixels_amodal=hand.pixels_amodal,
        object_pixels_visible=obj.pixels_visible,
        object_pixels_amodal=obj.pixels_amodal,
        hand_visible_fraction=hand.visible_fraction,
        object_visible_fraction=obj.visible_fraction,
        contact_force_n=sampled.contact_force_n[frame_index],
        hand_object_distance_m=hand_object_distance_m,
        rgb=rgb,
        masks=encode_masks(geometry.masks),
        geometry=encode_geometry(
            geometry.depth, geometry.depth_object, geometry.normals_cam, compression=config.depth_compression
        ),
    )
