"""Scene: everything that decides the images of one motion. Knows nothing of Blender."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from datagen.hands.arm import ARM_SKIN, HAND_SKIN, SLEEVE
from datagen.objects.mesh.object_mesh import ObjectMesh

__all__ = [
    "ARM_SKIN",
    "HAND_SKIN",
    "SLEEVE",
    "AreaLight",
    "Background",
    "CameraPath",
    "HandLook",
    "HandSurface",
    "RenderSettings",
    "Scene",
    "Table",
]


@dataclass(frozen=True, kw_only=True)
class CameraPath:
    """One camera over the whole motion; OpenCV axes, pixels."""

    kind: Literal["orbit", "arc", "handheld", "dolly", "egocentric"]
    K: Float[np.ndarray, "3 3"]
    image_size: tuple[int, int]  # (width, height)
    T_cam_from_world: Float[np.ndarray, "frame 4 4"]


@dataclass(frozen=True, kw_only=True)
class AreaLight:
    """A rectangular lamp that shines along its local -Z (built from `look direction`)."""

    position_world: Float[np.ndarray, "3"]
    target_world: Float[np.ndarray, "3"]
    power_w: float
    size_m: float
    color_rgb: tuple[float, float, float]  # linear


@dataclass(frozen=True, kw_only=True)
class Background:
    """Image-based light and what is seen behind the scene."""

    hdri: str  # name of one of the HDRIs that ship with Blender ("studio"), or a file path
    rotation_rad: float
    strength: float  # mean luminance seen over the whole sphere; every HDRI is normalised to 1 first


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table top: a rounded slab whose upper face is the plane z = `top_z_m`."""

    top_z_m: float
    center_xy_m: tuple[float, float]
    size_xy_m: tuple[float, float]
    thickness_m: float
    yaw_rad: float
    material: Literal["wood", "stone", "cloth", "laminate"]
    color_a_rgb: tuple[float, float, float]  # linear
    color_b_rgb: tuple[float, float, float]
    pattern_scale: float
    roughness: float
    pattern_seed: int


@dataclass(frozen=True, kw_only=True)
class HandSurface:
    """Topology of the drawn hand, constant over time: hand, forearm and sleeve in one mesh.

    The first `n_hand_verts` vertices are the hand model's own; the rest is forearm and sleeve.
    """

    faces: Int[np.ndarray, "face 3"]
    corner_uv: Float[np.ndarray, "face 3 2"]
    face_part: Int[np.ndarray, " face"]  # HAND_SKIN, ARM_SKIN or SLEEVE
    n_hand_verts: int


@dataclass(frozen=True, kw_only=True)
class HandLook:
    """Appearance of hand, forearm and sleeve."""

    skin_png: bytes  # sRGB colour texture for HAND_SKIN faces (and the forearm's mean colour)
    skin_coefficients: Float[np.ndarray, " coefficient"]
    skin_roughness: float
    subsurface: float  # weight 0..1
    bump: float  # strength of fine skin relief, 0..1
    nail_gloss: float  # 0..1
    sleeve_color_rgb: tuple[float, float, float]  # linear
    sleeve_weave: float  # size of the weave; 1: threads 1.2 mm apart
    nail_mask_png: bytes | None = None  # white on the nails, in the UV layout of `skin_png`


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """Cycles settings that change pixels."""

    samples: int
    max_bounces: int
    denoise: bool
    exposure_ev: float
    view_transform: Literal["AgX", "Filmic", "Standard"]


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Everything that decides the images of one motion. World: Z up, metres."""

    motion_id: str
    fps: float
    object_uid: str
    object_mesh: ObjectMesh
    T_world_from_obj: Float[np.ndarray, "frame 4 4"]
    hand_surface: HandSurface
    hand_verts_world: Float[np.ndarray, "frame hand_vert 3"]
    hand_look: HandLook
    cameras: tuple[CameraPath, ...]
    lights: tuple[AreaLight, ...]
    background: Background
    table: Table | None
    render: RenderSettings
    seed: int  # for Blender-side noise textures and Cycles' own sampling seed
