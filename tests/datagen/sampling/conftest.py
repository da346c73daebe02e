"""A complete configuration, the open hand, and motions made by hand: no simulation is needed here."""

import numpy as np
import pytest
import trimesh
import yaml
from scipy.spatial.transform import Rotation

from datagen.grasps.sequence import GraspQuality, GraspSequence, StartKind, TableEdge
from datagen.hands.model import ShapedHand, load_open_hand, pose_hand, shape_hand
from datagen.hands.skin import SkinBasis
from datagen.objects.asset.object_asset import ConvexPart, ObjectAsset, WatertightMesh
from datagen.objects.mesh.object_mesh import Material, ObjectMesh
from datagen.objects.mesh.texture_quality import TextureQuality
from datagen.sampling.config import SamplingConfig
from shards.settings import settings_from_dict

SETTINGS = """
clip:
  n_frames: 12
  fps: [6.0, 8.0, 10.0]
  pickup_probability: 0.3
  before_grasp_s: 0.4
  preference: 1.5
cameras:
  n_cameras: 2
  image_size: [256, 256]
  margin: 0.03
  near_m: 0.12
  slack: [1.0, 1.2]
  max_drift: 0.08
  smoothing_s: 0.25
  limits: {angular_speed_deg_s: 60.0, angular_acceleration_deg_s2: 240.0, shake_band_hz: [0.3, 1.5]}
  styles:
    orbit:
      {weight: 1.0, fov_deg: [30.0, 55.0], elevation_deg: [8.0, 55.0], azimuth_sweep_deg: [40.0, 180.0],
       elevation_sweep_deg: [0.0, 10.0], zoom_out: [1.0, 1.08], floor_distance_m: [0.25, 0.25],
       roll_deg: 3.0, shake_deg: 0.3, shake_m: 0.001}
    arc:
      {weight: 1.0, fov_deg: [30.0, 55.0], elevation_deg: [5.0, 70.0], azimuth_sweep_deg: [15.0, 60.0],
       elevation_sweep_deg: [10.0, 35.0], zoom_out: [1.0, 1.1], floor_distance_m: [0.25, 0.25],
       roll_deg: 4.0, shake_deg: 0.3, shake_m: 0.001}
    handheld:
      {weight: 1.0, fov_deg: [34.0, 58.0], elevation_deg: [8.0, 60.0], azimuth_sweep_deg: [0.0, 15.0],
       elevation_sweep_deg: [0.0, 8.0], zoom_out: [1.0, 1.1], floor_distance_m: [0.25, 0.25],
       roll_deg: 10.0, shake_deg: 2.5, shake_m: 0.006}
    dolly:
      {weight: 0.6, fov_deg: [28.0, 60.0], elevation_deg: [8.0, 55.0], azimuth_sweep_deg: [0.0, 12.0],
       elevation_sweep_deg: [0.0, 5.0], zoom_out: [1.2, 1.6], floor_distance_m: [0.25, 0.25],
       roll_deg: 3.0, shake_deg: 0.4, shake_m: 0.001}
    egocentric:
      {weight: 1.2, fov_deg: [30.0, 50.0], elevation_deg: [30.0, 68.0], azimuth_sweep_deg: [0.0, 20.0],
       elevation_sweep_deg: [0.0, 10.0], zoom_out: [1.0, 1.15], floor_distance_m: [0.35, 0.5],
       roll_deg: 8.0, shake_deg: 1.5, shake_m: 0.005}
  free_elevation_deg: [-35.0, 65.0]
  table_clearance_m: 0.06
  arm_clearance_m: 0.1
  min_visible: 0.12
  min_visible_mean: 0.4
  min_object_size: 0.12
  attempts: 24
  arm_end_attempts: 8
  probe_rays: 64
lights:
  card_level: [0.9, 1.6]
  hdri_share: [0.25, 0.7]
  hdris: {city: 1.0, interior: 1.0, night: 0.35, studio: 1.0, sunset: 0.9}
  n_lamps: [1, 4]
  fill_ratio: [0.1, 0.4]
  rim_ratio: [0.2, 0.7]
  elevation_deg: [20.0, 75.0]
  distance_m: [0.8, 1.8]
  size_m: [0.15, 0.8]
  temperature_k: [2800.0, 7500.0]
table:
  probability: 0.6
  size_m: [0.6, 1.5]
  thickness_m: [0.018, 0.045]
  lowered_m: [0.02, 0.2]
  materials: {wood: 1.0, stone: 0.6, cloth: 0.8, laminate: 0.6}
appearance:
  n_betas: 10
  betas_std: 1.0
  skin_roughness: [0.38, 0.58]
  subsurface: [0.12, 0.3]
  bump: [0.2, 0.6]
  nail_gloss: [0.2, 0.8]
  forearm_length_m: [0.2, 0.25]
  forearm_girth: [0.85, 1.2]
  sleeve_probability: 0.6
  sleeve_start_m: [0.02, 0.12]
  sleeve_weave: [0.7, 1.8]
render:
  samples: 16
  max_bounces: 4
  denoise: true
  exposure_ev: [-0.25, 0.25]
  view_transform: AgX
"""

FPS, GRASP_FRAME, N_FRAMES = 100.0, 120, 420
HALF_HEIGHT_M = 0.05


@pytest.fixture(scope="session")
def config() -> SamplingConfig:
    return settings_from_dict(SamplingConfig, yaml.safe_load(SETTINGS), "test settings")


@pytest.fixture(scope="session")
def hand() -> ShapedHand:
    return shape_hand(load_open_hand(), np.zeros(10))


@pytest.fixture(scope="session")
def skins() -> SkinBasis:
    """Two coefficients on a texture of four by four."""
    return SkinBasis(
        name="test",
        size=4,
        mean=np.full(48, 150.0),
        basis=np.linspace(-9.0, 9.0, 96).reshape(48, 2),
        index_map=np.arange(48),
        axes=("", ""),
        anchors=np.zeros((0, 2)),
    )


@pytest.fixture(scope="session")
def asset() -> ObjectAsset:
    can = trimesh.creation.cylinder(0.03, 2.0 * HALF_HEIGHT_M, sections=24)
    verts, faces = np.asarray(can.vertices, float), np.asarray(can.faces)
    return ObjectAsset(
        uid="can",
        name="can",
        source="test",
        licence="CC0-1.0",
        author="test",
        url="",
        mesh=ObjectMesh(
            verts_obj=verts,
            faces=faces,
            corner_uv=np.zeros((len(faces), 3, 2)),
            face_material=np.zeros(len(faces), dtype=int),
            materials=(Material(name="grey", base_color_rgba=(0.5, 0.5, 0.5, 1.0)),),
        ),
        watertight=WatertightMesh(
            verts_obj=verts,
            faces=faces,
            parts=(ConvexPart(verts_obj=verts, faces=faces),),
            watertight_source=True,
        ),
        catalogue_scale=1.0,
        texture=TextureQuality(texture_resolution_px=0, color_detail=0.0),
    )


@pytest.fixture(scope="session")
def make_sequence(hand):
    """A can on a table, a hand beside it that from GRASP_FRAME on carries and turns it."""

    def make(
        start: StartKind = "table", n_frames: int = N_FRAMES, edge: TableEdge | None = None
    ) -> GraspSequence:
        time = np.maximum(np.arange(n_frames) - GRASP_FRAME, 0) / FPS
        lift = 0.25 * (1.0 - np.exp(-3.0 * time))
        turn = Rotation.from_rotvec(np.outer(0.8 * (1.0 - np.exp(-time)), [0.3, 0.1, 1.0]))
        T = np.tile(np.eye(4), (n_frames, 1, 1))
        T[:, :3, :3] = turn.as_matrix()
        T[:, 2, 3] = HALF_HEIGHT_M + lift + (0.3 if start == "held" else 0.0)
        # Fingers point to -x in the rest frame: the palm ends beside the can, the arm level behind it.
        orientation = turn.as_rotvec()
        pose = np.zeros((n_frames, 45))
        rest = pose_hand(
            hand,
            orientation_world=orientation,
            hand_pose=pose,
            translation_world=np.zeros((n_frames, 3)),
            flat_hand_mean=True,
        )
        knuckle = rest.joints_world[:, 4]
        beside = T[:, :3, 3] + turn.apply([0.0, 0.06, 0.03]) - knuckle
        return GraspSequence(
            sequence_id="by-hand",
            object_uid="can",
            hand_model=hand.model.name,
            side=hand.model.side,
            fps=FPS,
            flat_hand_mean=True,
            betas=hand.betas,
            hand_orientation_world=orientation,
            hand_pose=pose,
            hand_translation_world=beside,
            T_world_from_obj=T,
            contact_force_n=np.tile(np.arange(n_frames)[:, None], (1, 5)).astype(float),
            grasp_frame=GRASP_FRAME,
            quality=GraspQuality(
                rise_m=0.25,
                center_distance_m=0.06,
                max_penetration_m=0.0,
                digits_in_contact=3,
                slip_lift_m=0.0,
                slip_manipulation_m=0.0,
                contact_force_n=5.0,
                attempts=1,
                digit_distance_m=np.zeros(5),
            ),
            start=start,
            table_edge=edge,
            first_drawn_frame=GRASP_FRAME if start == "held" else 0,
        )

    return make
