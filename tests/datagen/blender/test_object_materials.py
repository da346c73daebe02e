"""Images and corner colours as Cycles draws them: the same as images made for it with NumPy."""

import dataclasses
import io
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from datagen.objects.mesh.object_mesh import ImageLayout, Material, ObjectMesh
from datagen.scene.scene import CameraPath, RenderSettings, Scene
from shards.geometry import look_at
from shards.texture_wrap import Wrap

pytestmark = pytest.mark.blender
WRAPS: tuple[Wrap, ...] = ("repeat", "mirror", "clamp")
SIDE_M, PITCH_M, IMAGE_PX = 0.04, 0.05, 160
TEXELS = np.random.default_rng(0).integers(40, 255, (8, 8, 3), dtype=np.uint8)
TINT = (0.5, 0.25, 1.0)


def png(pixels: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    return buffer.getvalue()


def expanded(wrap_u: Wrap, wrap_v: Wrap) -> np.ndarray:
    """What is seen from -2 to 3 on both axes; v grows upward, rows downward."""

    def rows(pixels: np.ndarray, wrap: Wrap) -> np.ndarray:
        if wrap == "repeat":
            return np.concatenate([pixels] * 5)
        if wrap == "mirror":
            return np.concatenate([pixels, pixels[::-1], pixels, pixels[::-1], pixels])
        return np.pad(pixels, ((16, 16), (0, 0), (0, 0)), mode="edge")

    return rows(rows(TEXELS, wrap_v).transpose(1, 0, 2), wrap_u).transpose(1, 0, 2)


def board(
    materials: list[Material], low: float, high: float, tints: Sequence[tuple[float, ...]] | None
) -> ObjectMesh:
    """Squares in a 4 x 3 grid in the plane y = 0, seen from -y; UVs low..high, the last one by its second layer."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]]) * SIDE_M
    places = [(PITCH_M * (k % 4), 0, PITCH_M * (k // 4)) for k in range(len(materials))]
    verts = np.concatenate([corners + place for place in places])
    verts -= 0.5 * (verts.min(axis=0) + verts.max(axis=0))
    halves = np.array([[0, 1, 2], [0, 2, 3]])
    faces = (4 * np.arange(len(materials))[:, None, None] + halves).reshape(-1, 3)
    uv = np.array([[low, low], [high, low], [high, high], [low, high]], dtype=float)[halves]
    corner_uv = np.tile(uv, (len(materials), 1, 1, 1)).reshape(-1, 3, 2)
    colors = None if tints is None else np.repeat(np.repeat(np.array(tints)[:, None], 2, 0), 3, 1)
    layered = any(material.base_color_layout.uv_layer for material in materials)
    return ObjectMesh(
        verts_obj=verts,
        faces=faces,
        corner_uv=np.zeros_like(corner_uv) if layered else corner_uv,
        face_material=np.repeat(np.arange(len(materials)), 2),
        materials=tuple(materials),
        corner_colors=colors,
        more_corner_uv=(corner_uv,) if layered else (),
    )


def shown(scene: Scene, mesh: ObjectMesh) -> Scene:
    """One frame of the board alone, square before the camera."""
    camera = CameraPath(
        kind="orbit",
        K=np.array([[160.0, 0, 80], [0, 160.0, 80], [0, 0, 1]]),
        image_size=(IMAGE_PX, IMAGE_PX),
        T_cam_from_world=look_at(np.array([[0, -0.2, 0]]), np.zeros((1, 3))),
    )
    return dataclasses.replace(
        scene,
        object_mesh=mesh,
        T_world_from_obj=np.eye(4)[None],
        hand_verts_world=scene.hand_verts_world[:1] + np.array([0.0, 0.0, -50.0]),
        cameras=(camera,),
        table=None,
        render=RenderSettings(
            samples=4, max_bounces=0, denoise=False, exposure_ev=0.0, view_transform="Standard"
        ),
    )


def image_of(render, scene: Scene, folder: Path) -> np.ndarray:
    done = render(scene, folder)
    assert done.status == 0, done.stderr
    (path,) = folder.glob("cam-*/frame-*.png")
    return np.asarray(Image.open(path)).astype(int)


@pytest.mark.parametrize("uv_layer", [0, 1])
def test_wrap_modes_uv_layers_and_tints_are_drawn(render, box_scene, tmp_path, uv_layer):
    """Nine pairs of wrap modes over -1..2, and one tinted square, against images that need none of it."""
    pairs = list(product(WRAPS, WRAPS))
    plain = Material(name="plain", base_color_rgba=(0.8, 0.8, 0.8, 1.0), base_color_image=png(TEXELS))
    wrapped = [
        dataclasses.replace(
            plain, base_color_layout=ImageLayout(uv_layer=uv_layer, wrap_u=wrap_u, wrap_v=wrap_v)
        )
        for wrap_u, wrap_v in pairs
    ]
    made = [dataclasses.replace(plain, base_color_image=png(expanded(u, v))) for u, v in pairs]
    white = Material(name="white", base_color_rgba=(0.8, 0.8, 0.8, 1.0))
    tinted = dataclasses.replace(white, base_color_rgba=(0.4, 0.2, 0.8, 1.0))
    tints = [(1.0, 1.0, 1.0)] * len(pairs) + [TINT]
    ours = image_of(render, shown(box_scene, board([*wrapped, white], -1, 2, tints)), tmp_path / "ours")
    expected = image_of(
        render, shown(box_scene, board([*made, tinted], 0.2, 0.8, None)), tmp_path / "expected"
    )
    assert expected.std() > 20  # something is seen
    assert np.abs(ours - expected).max() <= 1
