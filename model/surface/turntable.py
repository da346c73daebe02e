"""A full turn around a mesh, as frames of a film."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from model.surface.mesh import SurfaceMesh
from model.surface.rasteriser import Shading, render_mesh
from shards.geometry import intrinsics_from_fov, look_at

__all__ = ["TurntableConfig", "turntable", "turntable_cameras"]


@dataclass(frozen=True, kw_only=True)
class TurntableConfig:
    """How the camera goes around the object."""

    frames: int
    size_px: int  # images are square
    supersampling: int  # rendered larger by this factor, then averaged
    fov_rad: float
    elevation_rad: float
    shading: Shading


def turntable(mesh: SurfaceMesh, config: TurntableConfig) -> UInt8[np.ndarray, "frame size size 3"]:
    """Images from cameras once around the up axis (+Z), the whole mesh in every one; sRGB."""
    large = config.size_px * config.supersampling
    K = intrinsics_from_fov(config.fov_rad, (large, large))
    frames = []
    for T_cam_from_obj in turntable_cameras(mesh, config):
        rgb = render_mesh(mesh, K, T_cam_from_obj, (large, large), config.shading).rgb
        blocks = rgb.reshape(config.size_px, config.supersampling, config.size_px, config.supersampling, 3)
        frames.append(np.round(blocks.mean(axis=(1, 3))).astype(np.uint8))
    return np.stack(frames)


def turntable_cameras(mesh: SurfaceMesh, config: TurntableConfig) -> Float[np.ndarray, "frame 4 4"]:
    """`T_cam_from_obj` of the turn about the box's centre, as near as the bounding ball allows."""
    center = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)).astype(np.float64)
    radius = float(np.linalg.norm(mesh.vertices - center, axis=1).max())
    distance = 1.05 * radius / np.sin(0.5 * config.fov_rad)
    azimuth = 2.0 * np.pi * np.arange(config.frames) / config.frames
    c, s = np.cos(config.elevation_rad), np.sin(config.elevation_rad)
    # The first camera stands at -Y, where glTF has the front.
    direction = np.stack([c * np.sin(azimuth), -c * np.cos(azimuth), np.full_like(azimuth, s)], axis=1)
    return look_at(center + distance * direction, np.broadcast_to(center, direction.shape))
