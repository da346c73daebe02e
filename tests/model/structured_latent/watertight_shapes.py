"""Objects whose surface is known in closed form, as a shard would describe them."""

from collections.abc import Callable

import numpy as np

from datagen.objects.targets.learning_targets import LearningTargets
from model.data.batch import Batch, SurfaceTarget, join_surfaces
from shards.schema import ObjectRow

RESOLUTION = 64

Distance = Callable[[np.ndarray], np.ndarray]


def ball_distance(radius: float) -> Distance:
    return lambda points: np.linalg.norm(points, axis=-1) - radius


def plate_distance(half: np.ndarray) -> Distance:
    """Exact signed distance to a box."""

    def distance(points: np.ndarray) -> np.ndarray:
        q = np.abs(points) - half
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)

    return distance


def _surface(
    points: np.ndarray, normals: np.ndarray, distance: Distance, rng: np.random.Generator
) -> SurfaceTarget:
    near = (
        points[: len(points) // 2]
        + 0.02 * rng.standard_normal((len(points) // 2, 1)) * normals[: len(points) // 2]
    )
    sdf_points = np.concatenate([near, rng.uniform(-0.5, 0.5, (len(points) // 4, 3))])
    return SurfaceTarget(
        points=points.astype(np.float32),
        normals=normals.astype(np.float32),
        colors=np.round(255 * (points + 0.5)).astype(np.uint8),  # so that colour tells the place
        sdf_points=sdf_points.astype(np.float32),
        sdf_values=distance(sdf_points).astype(np.float32),
        object_scale_m=0.1,
    )


def ball(count: int = 6000, radius: float = 0.3, seed: int = 0) -> SurfaceTarget:
    rng = np.random.default_rng(seed)
    normals = rng.standard_normal((count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return _surface(radius * normals, normals, ball_distance(radius), rng)


def plate(half: tuple[float, float, float], count: int = 8000, seed: int = 0) -> SurfaceTarget:
    """A box; points even over its faces."""
    rng, size = np.random.default_rng(seed), np.array(half)
    areas = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    axis, side = rng.choice(3, count, p=areas / areas.sum()), rng.choice([-1.0, 1.0], count)
    points = rng.uniform(-size, size, (count, 3))
    points[np.arange(count), axis] = side * size[axis]
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = side
    return _surface(points, normals, plate_distance(size), rng)


def shell(distance: Distance, resolution: int = RESOLUTION) -> np.ndarray:
    """Occupancy: the voxels whose corners are not all on one side."""
    axis = np.arange(resolution + 1) / resolution - 0.5
    inside = distance(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)) < 0
    corners = [
        inside[i : i + resolution, j : j + resolution, k : k + resolution]
        for i in (0, 1)
        for j in (0, 1)
        for k in (0, 1)
    ]
    return np.any(corners, axis=0) & ~np.all(corners, axis=0)


def surface_of(row: ObjectRow | LearningTargets) -> SurfaceTarget:
    """The samples of an object, as they are stored or as the generator makes them."""
    return SurfaceTarget(
        points=row.surface_points,
        normals=row.surface_normals,
        colors=row.surface_colors,
        sdf_points=row.sdf_points,
        sdf_values=row.sdf_values,
        object_scale_m=row.object_scale_m,
    )


def batch_of(*objects: tuple[SurfaceTarget, np.ndarray], views: int = 2, size: int = 32) -> Batch:
    """Objects with grey noise for images."""
    import torch

    n = len(objects)
    generator = torch.Generator().manual_seed(n)
    blank = torch.zeros(n, views, size, size, dtype=torch.bool)
    return Batch(
        images=torch.rand(n, views, 3, size, size, generator=generator),
        object_amodal=blank,
        object_visible=blank,
        hand_visible=blank,
        K=torch.eye(3).expand(n, views, 3, 3).clone(),
        T_cam_from_canonical=torch.eye(4).expand(n, views, 4, 4).clone(),
        occupancy=torch.from_numpy(np.stack([occupancy for _, occupancy in objects])),
        joints_px=torch.zeros(n, views, 21, 2),
        is_right=torch.ones(n, dtype=torch.bool),
        ids=tuple(f"motion-{i}:0:{i}" for i in range(n)),
        surface=join_surfaces([surface for surface, _ in objects], [f"object-{i}" for i in range(n)]),
    )
