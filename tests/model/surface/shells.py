"""Decoder outputs made from distance functions: voxels near a surface, numbers at their corners."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from model.surface.fields import CORNERS, SurfaceFields

Distance = Callable[[np.ndarray], np.ndarray]


def ball(radius: float, center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Distance:
    return lambda points: np.linalg.norm(points - np.array(center), axis=-1) - radius


def torus(ring: float, tube: float) -> Distance:
    return lambda p: np.hypot(np.hypot(p[..., 0], p[..., 1]) - ring, p[..., 2]) - tube


def union(*parts: Distance) -> Distance:
    return lambda points: np.min([part(points) for part in parts], axis=0)


def grid(resolution: int) -> Int[np.ndarray, "voxel 3"]:
    return np.stack(np.meshgrid(*[np.arange(resolution)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def shell_fields(resolution: int, distance: Distance, *, coarse: int, keep: float = 1.0) -> SurfaceFields:
    """Coarse voxels within reach of the surface, cut into fine ones; colour = sigmoid(4 position).

    `keep` is the share of coarse voxels that stay; which ones is fixed.
    """
    cells = grid(coarse)
    near = cells[np.abs(distance((cells + 0.5) / coarse - 0.5)) < 0.9 / coarse]
    near = near[np.random.default_rng(0).random(len(near)) < keep]
    fine = resolution // coarse
    voxels = (near[:, None] * fine + grid(fine)).reshape(-1, 3)
    corners = corner_points(voxels, resolution)
    return SurfaceFields(
        resolution=resolution,
        voxels=voxels,
        distances=distance(corners).astype(np.float32),
        deformations=np.zeros((len(voxels), 8, 3), dtype=np.float32),
        color_logits=(4.0 * corners).astype(np.float32),
    )


def corner_points(voxels: Int[np.ndarray, "voxel 3"], resolution: int) -> Float[np.ndarray, "voxel 8 3"]:
    return (voxels[:, None] + CORNERS) / resolution - 0.5


def noise_fields(
    seed: int, *, resolution: int, deformation: float, levels: int | None = None
) -> SurfaceFields:
    """Random voxels with random numbers: nothing a network emits can be worse. `levels`: few integer distances."""
    rng = np.random.default_rng(seed)
    voxels = rng.permutation(grid(resolution))[: rng.integers(1, resolution**3 + 1)]
    n = len(voxels)
    values = rng.normal(size=(n, 8)) if levels is None else rng.integers(-levels, levels + 1, (n, 8))
    values[0] = -1.0  # something is inside
    return SurfaceFields(
        resolution=resolution,
        voxels=voxels,
        distances=values.astype(np.float32),
        deformations=(deformation * rng.normal(size=(n, 8, 3))).astype(np.float32),
        color_logits=rng.normal(size=(n, 8, 3)).astype(np.float32),
    )
