"""Shapes whose inside, surface and volume are known exactly."""

import numpy as np
import pytest
import trimesh

from datagen.objects.mesh.object_mesh import Material, ObjectMesh
from datagen.objects.watertight.convex_parts import ConvexConfig
from datagen.objects.watertight.level_set import LevelSetConfig
from datagen.objects.watertight.preparation import PreparationConfig
from datagen.objects.watertight.watertight_mesh import WatertightConfig

Surface = tuple[np.ndarray, np.ndarray]


@pytest.fixture
def watertight_config() -> WatertightConfig:
    """Coarse, so tests take a second: 1 mm on a 10 cm object."""
    return WatertightConfig(
        level_set=LevelSetConfig(voxels_longest=100, min_voxel_m=0.0003, max_hole_m=0.004, sheet_voxels=1.8),
        tolerance_m=5e-5,
        max_faces=12000,
    )


@pytest.fixture
def quick_preparation(watertight_config: WatertightConfig) -> PreparationConfig:
    """One coarse convex part: for tests that are about loading."""
    convex = ConvexConfig(
        thresholds=(0.5,),
        max_hulls=1,
        max_hull_verts=32,
        hull_tolerance_m=0.001,
        max_excess_m=1.0,
        max_faces=500,
        mcts_iterations=5,
        seed=0,
    )
    return PreparationConfig(watertight=watertight_config, convex=convex)


@pytest.fixture
def box() -> Surface:
    """10 x 8 x 6 cm around the origin."""
    made = trimesh.creation.box((0.10, 0.08, 0.06))
    return np.array(made.vertices), np.array(made.faces)


@pytest.fixture
def open_box(box: Surface) -> Surface:
    """The same box as single sheets without its lid (+z)."""
    verts, faces = box
    normals = trimesh.Trimesh(verts, faces, process=False).face_normals
    return verts, faces[normals[:, 2] < 0.5]


@pytest.fixture
def crossing_boxes(box: Surface) -> Surface:
    """Two boxes through each other: 10 x 8 x 6 and a 3 x 3 x 15 cm post; 480 + 81 cm3."""
    verts, faces = box
    post = trimesh.creation.box((0.03, 0.03, 0.15))
    return np.concatenate([verts, post.vertices]), np.concatenate([faces, post.faces + len(verts)])


@pytest.fixture
def sheet_cup() -> Surface:
    """A paper cup: one sheet, radius 3 -> 4 cm, height 10 cm, open at the top."""
    n = 64
    angle = np.arange(n) * 2 * np.pi / n
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    bottom = np.column_stack([0.03 * ring, np.full(n, -0.05)])
    top = np.column_stack([0.04 * ring, np.full(n, 0.05)])
    verts = np.concatenate([bottom, top, [[0.0, 0.0, -0.05]]])
    k = np.arange(n)
    following = (k + 1) % n
    faces = np.concatenate(
        [
            np.stack([k, following, following + n], axis=1),
            np.stack([k, following + n, k + n], axis=1),
            np.stack([following, k, np.full(n, 2 * n)], axis=1),
        ]
    )
    return verts, faces


@pytest.fixture
def plain_mesh():
    """ObjectMesh of one grey material from vertices and faces."""

    def make(verts: np.ndarray, faces: np.ndarray) -> ObjectMesh:
        return ObjectMesh(
            verts_obj=np.asarray(verts, dtype=np.float64),
            faces=np.asarray(faces, dtype=np.int64),
            corner_uv=np.zeros((len(faces), 3, 2)),
            face_material=np.zeros(len(faces), dtype=np.int64),
            materials=(Material(name="grey", base_color_rgba=(0.5, 0.5, 0.5, 1.0)),),
        )

    return make
