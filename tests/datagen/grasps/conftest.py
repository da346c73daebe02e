"""Analytic objects, the open hand and a complete configuration."""

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from datagen.grasps.config import GraspConfig
from datagen.hands.model import ShapedHand, load_open_hand, shape_hand
from datagen.objects.asset.object_asset import ConvexPart, ObjectAsset, WatertightMesh
from datagen.objects.mesh.object_mesh import Material, ObjectMesh
from datagen.objects.mesh.texture_quality import TextureQuality

CONFIG = GraspConfig(
    max_attempts=20,
    table_start_weight=1.0,
    edge_start_weight=1.0,
    held_start_weight=0.3,
    contact_pairs=600,
    proposals=8,
    simulated_per_start=2,
    density_kg_m3=300.0,
    mass_kg=(0.03, 0.5),
    friction=1.0,
    grip_factor=3.0,
    grip_force_n=(6.0, 16.0),
    contact_distance_m=0.0005,
    forearm_length_m=0.25,
    forearm_radius_m=0.045,
    table_clearance_m=0.004,
    approach_s=0.5,
    close_s=0.9,
    lift_s=0.8,
    lift_height_m=(0.2, 0.3),
    turns=(3, 5),
    turn_angle_rad=(0.7, 1.8),
    turn_speed_rad_s=1.6,
    min_rise_m=0.1,
    max_center_distance_m=0.1,
    min_digits=3,
    max_penetration_m=0.003,
    max_slip_m=0.010,
    min_movement_rad=0.8,
)
HAND = shape_hand(load_open_hand(), np.zeros(10))


@pytest.fixture(scope="session")
def config() -> GraspConfig:
    return CONFIG


@pytest.fixture(scope="session")
def hand() -> ShapedHand:
    return HAND


def convex_object(uid: str, mesh: trimesh.Trimesh) -> ObjectAsset:
    verts, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    return ObjectAsset(
        uid=uid,
        name=uid,
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


def make_objects() -> dict[str, ObjectAsset]:
    create = trimesh.creation
    return {
        "can": convex_object("can", create.cylinder(0.03, 0.12, sections=40)),
        "box": convex_object("box", create.box((0.05, 0.07, 0.14))),
        "plate": convex_object("plate", create.box((0.058, 0.115, 0.009))),
        "comb": convex_object("comb", create.box((0.125, 0.036, 0.004))),
    }


@pytest.fixture(scope="session")
def objects() -> dict[str, ObjectAsset]:
    return make_objects()


@pytest.fixture(scope="session")
def make_object() -> Callable[[str, trimesh.Trimesh], ObjectAsset]:
    return convex_object
