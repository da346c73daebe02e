"""The ball of tests/shards/synthetic.py with a real textured mesh, whose colour tells the place on it."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from model.surface.export import ROTATION_YUP_FROM_OBJ
from shards.color import linear_from_srgb, srgb_from_linear
from shards.schema import ObjectRow
from tests.model.data.balls import write_balls
from tests.shards.synthetic import RADIUS_M

CENTER_OBJ = np.array([0.01, 0.0, 0.0])
FACTOR = (1.0, 128 / 255, 1.0)  # linear; of the material's colour


def ball_colors(directions: np.ndarray) -> np.ndarray:
    """sRGB 0..1 of the texture: red, green and blue grow along x, y and z."""
    return 0.5 + 0.4 * directions


def ball_glb(*, texture_px: int = 256, steps: int = 64) -> bytes:
    """Y up, metres, as shards hold it."""
    u, v = np.meshgrid(np.linspace(0, 1, 2 * steps + 1), np.linspace(0, 1, steps + 1))
    directions = _directions(u, v).reshape(-1, 3)
    row, column = np.divmod(np.arange(2 * steps * steps), 2 * steps)
    a = row * (2 * steps + 1) + column
    b, c, d = a + 1, a + 2 * steps + 1, a + 2 * steps + 2
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    x = (np.arange(2 * texture_px) + 0.5) / (2 * texture_px)
    y = 1 - (np.arange(texture_px) + 0.5) / texture_px  # the first row is at the top, v = 1
    image = np.round(255 * ball_colors(_directions(*np.meshgrid(x, y)))).astype(np.uint8)
    mesh = trimesh.Trimesh(
        vertices=(CENTER_OBJ + RADIUS_M * directions) @ ROTATION_YUP_FROM_OBJ.T,
        faces=faces,
        vertex_normals=directions @ ROTATION_YUP_FROM_OBJ.T,
        visual=trimesh.visual.TextureVisuals(
            uv=np.stack([u.ravel(), v.ravel()], axis=1),
            material=trimesh.visual.material.PBRMaterial(
                baseColorTexture=Image.fromarray(image), baseColorFactor=[*FACTOR, 1.0]
            ),
        ),
        process=False,
    )
    exported = mesh.export(file_type="glb", include_normals=True)
    assert isinstance(exported, bytes)
    return exported


def _directions(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    longitude, latitude = 2 * np.pi * u, np.pi * (v - 0.5)
    return np.stack(
        [np.cos(longitude) * np.cos(latitude), np.sin(longitude) * np.cos(latitude), np.sin(latitude)], -1
    )


def with_mesh(row: ObjectRow) -> ObjectRow:
    glb = ball_glb()
    shown = srgb_from_linear(linear_from_srgb(ball_colors(row.surface_normals)) * FACTOR)
    return replace(
        row,
        mesh_glb=glb,
        mesh_sha256=hashlib.sha256(glb).hexdigest(),
        surface_colors=np.round(255 * shown).astype(np.uint8),
    )


def without_mesh(row: ObjectRow) -> ObjectRow:
    """As a shard holds it whose licence forbids copies."""
    return replace(with_mesh(row), mesh_glb=None)


def write_textured_balls(root: Path, *, with_meshes: bool = True) -> Path:
    return write_balls(root, change_object=with_mesh if with_meshes else without_mesh)
