"""sample_scene: one grasp sequence becomes one Scene. Every draw comes from a named stream."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.geometry.raycast import TriangleCaster
from datagen.grasps.sequence import GraspSequence
from datagen.hands.arm import DressedHand, dress_hand
from datagen.hands.model import ShapedHand
from datagen.hands.skin import SkinBasis
from datagen.objects.asset.object_asset import ObjectAsset
from datagen.sampling.appearance import sample_arm_style, sample_look
from datagen.sampling.cameras import CameraMetrics, CamerasConfig, Surroundings, sample_cameras
from datagen.sampling.clip import clip_windows
from datagen.sampling.config import RenderConfig, SamplingConfig
from datagen.sampling.errors import SamplingError
from datagen.sampling.framing import Subject
from datagen.sampling.lights import sample_light
from datagen.sampling.placement import Placement, arm_end_verts, object_mesh_hull, place
from datagen.sampling.streams import Stream, stream_rng
from datagen.sampling.visibility import VisibilityProbe
from datagen.scene.scene import CameraPath, HandSurface, RenderSettings, Scene

__all__ = ["SampledMotion", "sample_scene"]


@dataclass(frozen=True, kw_only=True)
class SampledMotion:
    """A Scene with what its images are labelled with; all arrays are of the drawn frames."""

    scene: Scene
    sequence: GraspSequence  # where it comes from, whole
    grasp_frame: int  # first drawn frame in which the hand carries the object; n_frames: never
    hand_orientation_world: Float[np.ndarray, "frame 3"]
    hand_pose: Float[np.ndarray, "frame 45"]
    hand_translation_world: Float[np.ndarray, "frame 3"]
    betas: Float[np.ndarray, " beta"]
    skin_model: str
    joints_world: Float[np.ndarray, "frame 21 3"]
    contact_force_n: Float[np.ndarray, "frame 5"]
    movement_rad: float  # of the object over the clip: turn + travel / 0.3 m
    camera_metrics: tuple[CameraMetrics, ...]  # in the order of scene.cameras


def sample_scene(
    sequence: GraspSequence,
    hand: ShapedHand,
    skins: SkinBasis,
    asset: ObjectAsset,
    config: SamplingConfig,
    *,
    dataset_seed: int,
    motion_index: int,
    motion_id: str,
) -> SampledMotion:
    """Draw clip window, table, cameras, lights and looks of one motion.

    A pure function of its arguments. Raises SamplingError, with metrics, when the motion is too short,
    sinks into its table, or has no camera that sees enough of the object.
    """
    _require_same_hand(sequence, hand)

    def rng(stream: Stream, *parts: int) -> np.random.Generator:
        return stream_rng(dataset_seed, motion_index, stream, *parts)

    dressed = dress_hand(hand, sample_arm_style(rng(Stream.SLEEVE), config.appearance))
    hull = object_mesh_hull(asset.mesh)
    windows = clip_windows(sequence, config.clip, rng(Stream.CLIP))
    placed = place(sequence, windows, dressed, hull, config.table, rng(Stream.TABLE))
    frames, fps = placed.window.frames, placed.window.fps
    T_world_from_obj = sequence.T_world_from_obj[frames]
    # The first camera's generator also turns the whole ring of cameras; parts start at 1 because
    # a SeedSequence does not tell a missing word from 0.
    camera_rngs = [rng(Stream.CAMERAS, 1 + camera) for camera in range(config.cameras.n_cameras)]
    cameras, metrics = _cameras(config.cameras, asset, hull, dressed, placed, T_world_from_obj, camera_rngs)
    center = placed.object_verts_world.mean(axis=(0, 1))
    lights, background = sample_light(config.lights, center, rng(Stream.LIGHTS), rng(Stream.BACKGROUND))
    scene = Scene(
        motion_id=motion_id,
        fps=fps,
        object_uid=asset.uid,
        object_mesh=asset.mesh,
        T_world_from_obj=T_world_from_obj,
        hand_surface=HandSurface(
            faces=dressed.faces,
            corner_uv=dressed.corner_uv,
            face_part=dressed.face_part,
            n_hand_verts=dressed.n_hand_verts,
        ),
        hand_verts_world=placed.hand_verts_world,
        hand_look=sample_look(skins, config.appearance, rng(Stream.SKIN), rng(Stream.SLEEVE, 1)),
        cameras=cameras,
        lights=lights,
        background=background,
        table=placed.table,
        render=_render(config.render, rng(Stream.RENDER)),
        seed=int(rng(Stream.RENDER, 1).integers(2**31)),
    )
    return SampledMotion(
        scene=scene,
        sequence=sequence,
        grasp_frame=placed.window.first_grasped(sequence),
        hand_orientation_world=sequence.hand_orientation_world[frames],
        hand_pose=sequence.hand_pose[frames],
        hand_translation_world=sequence.hand_translation_world[frames],
        betas=sequence.betas,
        skin_model=skins.name,
        joints_world=placed.posed.joints_world,
        contact_force_n=sequence.contact_force_n[frames],
        movement_rad=placed.window.movement_rad,
        camera_metrics=metrics,
    )


def _require_same_hand(sequence: GraspSequence, hand: ShapedHand) -> None:
    theirs = (sequence.hand_model, sequence.side)
    ours = (hand.model.name, hand.model.side)
    if theirs != ours or not np.array_equal(sequence.betas, hand.betas):
        raise SamplingError(
            f"motion {sequence.sequence_id} is of hand {theirs} with betas "
            f"{np.round(sequence.betas, 3).tolist()}, found {ours} with {np.round(hand.betas, 3).tolist()}; "
            "pass the hand it was made with"
        )


def _cameras(
    config: CamerasConfig,
    asset: ObjectAsset,
    hull: Float[np.ndarray, "hull 3"],
    dressed: DressedHand,
    placed: Placement,
    T_world_from_obj: Float[np.ndarray, "frame 4 4"],
    rngs: list[np.random.Generator],
) -> tuple[tuple[CameraPath, ...], tuple[CameraMetrics, ...]]:
    n_hand = dressed.n_hand_verts
    hand, arm = placed.hand_verts_world[:, :n_hand], placed.hand_verts_world[:, n_hand:]
    middle = 0.5 * (hull.min(axis=0) + hull.max(axis=0))
    probe = VisibilityProbe(
        object_caster=TriangleCaster(asset.mesh.verts_obj, asset.mesh.faces),
        object_hull_obj=hull,
        T_world_from_obj=T_world_from_obj,
        hand_verts_world=placed.hand_verts_world,
        hand_faces=dressed.faces,
        arm_end=arm_end_verts(placed.hand_verts_world[0], n_hand, placed.posed.joints_world[0, 0]),
        rays_across=config.probe_rays,
    )
    wrist_to_elbow = arm.mean(axis=(0, 1)) - placed.posed.joints_world[:, 0].mean(axis=0)
    around = Surroundings(
        arm_verts_world=arm,
        forearm_direction_world=wrist_to_elbow / np.linalg.norm(wrist_to_elbow),
        table_top_z_m=None if placed.table is None else placed.table.top_z_m,
    )
    subject = Subject(
        points_world=np.concatenate([hand, placed.object_verts_world], axis=1),
        object_center_world=T_world_from_obj[:, :3, :3] @ middle + T_world_from_obj[:, :3, 3],
        fps=placed.window.fps,
    )
    return sample_cameras(config, subject, probe, around, rngs)


def _render(config: RenderConfig, rng: np.random.Generator) -> RenderSettings:
    return RenderSettings(
        samples=config.samples,
        max_bounces=config.max_bounces,
        denoise=config.denoise,
        exposure_ev=float(rng.uniform(*config.exposure_ev)),
        view_transform=config.view_transform,
    )
