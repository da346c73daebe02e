"""What the SLat encoder reads of an object: geometry and colour of its own voxels.

`object_features` needs the surface samples of a shard and no network; `projected_features` are TRELLIS's, image
features of many views averaged on the voxels (FORMATS 4.5).

The signed distance at a corner is extrapolated from the nearest sample, value + normal . (corner - sample).
Samples are the surface points (value 0, their normal) and the signed-distance samples; the gradient of one of
these is the normal of that of the four nearest surface points whose plane explains its value best.

How exact: against the watertight versions of the 48 starter objects (8,192 surface and 12,288 distance samples
each) the mean error is 0.06 voxels (median over objects 0.03, worst 0.23: an object of thin bars), the
95th percentile 0.3, and 2.2 % of the corners further than 0.1 voxels from the surface are on the wrong side (worst
12 %). 47 % of the active voxels hold no surface point (worst 85 %). It takes 0.13 s per object.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from scipy.spatial import KDTree
from torch import Tensor

from model.data.batch import SurfaceTarget
from model.encoders.protocol import FeatureEncoder
from model.errors import ModelError
from model.structured_latent.object_features.object_views import ObjectView
from model.surface.fields import CORNERS

__all__ = [
    "FEATURE_CHANNELS",
    "ProjectedFeatures",
    "SurfaceFeatures",
    "VoxelFeatures",
    "corner_distances",
    "object_features",
    "projected_features",
]

FEATURE_CHANNELS = 16
_LARGEST_DISTANCE = 2.0  # voxels; a corner of a voxel that the surface passes through is nearer than sqrt(3)
_FULL_COUNT = 8  # surface points in a voxel beyond which more say nothing
_GRADIENT_CANDIDATES = 4
_VIEWS_AT_ONCE = 8


@dataclass(frozen=True, kw_only=True)
class SurfaceFeatures:
    """Features of the object's own surface, `VoxelFeatures.rows`: nothing to choose."""


@dataclass(frozen=True, kw_only=True, eq=False)
class VoxelFeatures:
    """Features of the active voxels, in the order they were given; canonical axes.

    Normal and colour of a voxel without a surface point inside are those of the point nearest to its centre.
    """

    distances: Float32[np.ndarray, "voxel 8"]  # at CORNERS, in voxels, negative inside, within +-2
    normals: Float32[np.ndarray, "voxel 3"]  # mean of the surface points inside, length 0..1
    colors: Float32[np.ndarray, "voxel 3"]  # mean, sRGB 0..1
    counts: Int[np.ndarray, " voxel"]  # surface points inside

    def rows(self) -> Float32[np.ndarray, "voxel 16"]:
        """What the encoder reads: all of it, about -2..2; colours centred."""
        full = np.minimum(self.counts, _FULL_COUNT) / _FULL_COUNT
        own = np.stack([full, self.counts > 0], axis=1).astype(np.float32)
        return np.concatenate([self.distances, self.normals, 2.0 * self.colors - 1.0, own], axis=1)


def object_features(
    surface: SurfaceTarget, voxels: Int[np.ndarray, "voxel 3"], resolution: int
) -> VoxelFeatures:
    """Features of active voxels from the samples of the object's surface; deterministic.

    ModelError: no surface point at all.
    """
    if not len(surface.points):
        raise ModelError(
            "voxel features",
            "the object has no surface point",
            expected="surface_points in objects.parquet",
            action="Write the shard again.",
        )
    lattice, corner = np.unique(
        (voxels[:, None].astype(np.int64) + CORNERS).reshape(-1, 3), axis=0, return_inverse=True
    )
    distances = corner_distances(surface, lattice / resolution - 0.5) * resolution
    distances = np.clip(distances, -_LARGEST_DISTANCE, _LARGEST_DISTANCE)
    rows = _rows_of_points(surface.points, voxels, resolution)
    inside = rows >= 0
    counts = np.bincount(rows[inside], minlength=len(voxels))
    empty = counts == 0
    nearest = KDTree(surface.points).query((voxels[empty] + 0.5) / resolution - 0.5)[1]

    def mean(values: Float[np.ndarray, "surface 3"]) -> Float32[np.ndarray, "voxel 3"]:
        sums = [np.bincount(rows[inside], column, len(voxels)) for column in values[inside].T]
        means = np.stack(sums, axis=1) / np.maximum(counts, 1)[:, None]
        means[empty] = values[nearest]
        return means.astype(np.float32)

    return VoxelFeatures(
        distances=distances[corner.reshape(-1)].reshape(-1, 8).astype(np.float32),
        normals=mean(surface.normals),
        colors=mean(surface.colors / np.float32(255.0)),
        counts=counts,
    )


def corner_distances(
    surface: SurfaceTarget, points: Float[np.ndarray, "point 3"]
) -> Float[np.ndarray, " point"]:
    """Signed distance at points near the surface, from the nearest sample; canonical units, negative inside."""
    of_surface = KDTree(surface.points)
    candidates = min(_GRADIENT_CANDIDATES, len(surface.points))
    near = of_surface.query(surface.sdf_points, k=np.arange(1, candidates + 1))[1]
    normals = surface.normals[near]
    planes = np.einsum("skx,skx->sk", surface.sdf_points[:, None] - surface.points[near], normals)
    best = np.abs(planes - surface.sdf_values[:, None]).argmin(axis=1)
    gradients = np.take_along_axis(normals, best[:, None, None], axis=1)[:, 0]

    sample_points = np.concatenate([surface.points, surface.sdf_points])
    values = np.concatenate([np.zeros(len(surface.points), np.float32), surface.sdf_values])
    slopes = np.concatenate([surface.normals, gradients])
    nearest = KDTree(sample_points).query(points)[1]
    return values[nearest] + np.einsum("px,px->p", points - sample_points[nearest], slopes[nearest])


def _rows_of_points(
    points: Float32[np.ndarray, "point 3"], voxels: Int[np.ndarray, "voxel 3"], resolution: int
) -> Int[np.ndarray, " point"]:
    """Row of the voxel that each point lies in, -1 where that voxel is not active."""
    row = np.full((resolution,) * 3, -1)
    row[tuple(voxels.T)] = np.arange(len(voxels))
    cell = np.clip(np.floor((points + 0.5) * resolution).astype(np.int64), 0, resolution - 1)
    return row[tuple(cell.T)]


@dataclass(frozen=True, kw_only=True, eq=False)
class ProjectedFeatures:
    """Image features on voxels."""

    features: Float[Tensor, "voxel channel"]  # zero where `views` is 0
    views: Int[Tensor, " voxel"]  # that show the voxel's centre inside the image, in front of the camera


@torch.no_grad()
def projected_features(
    views: Iterable[ObjectView],
    voxels: Int[Tensor, "voxel 3"],
    resolution: int,
    encoder: FeatureEncoder,
) -> ProjectedFeatures:
    """Mean over the views of the bilinear features at the voxel centres' projections (FORMATS 4.5).

    Without a visibility test, as TRELLIS: a voxel on the far side gets the features in front of it. Views that show
    the centre outside the image do not count (TRELLIS, whose views show the whole object, counts them as zero).
    Float32, on the device of `voxels`, where the encoder is too; the images are of the whole unoccluded object.
    """
    device, rest = voxels.device, iter(views)
    centers = (voxels.float() + 0.5) / resolution - 0.5
    total = torch.zeros(len(voxels), encoder.channels, device=device)
    count = torch.zeros(len(voxels), dtype=torch.long, device=device)
    while some := list(islice(rest, _VIEWS_AT_ONCE)):
        images = torch.from_numpy(np.stack([view.image for view in some])).to(device)
        tokens = encoder(images.permute(0, 3, 1, 2)[None].float() / 255)[0].float()
        for view, of_view in zip(some, tokens, strict=True):
            at, seen = _projected(centers, view)
            grid = of_view.T.unflatten(1, (encoder.grid, encoder.grid))[None]
            # align_corners=False: token (r, c) is centred at (c + 0.5, r + 0.5) / grid, as encoders promise.
            sampled = torch.nn.functional.grid_sample(
                grid, at[None, None], mode="bilinear", padding_mode="border", align_corners=False
            )[0, :, 0].T
            total += torch.where(seen[:, None], sampled, 0.0)
            count += seen
    return ProjectedFeatures(features=total / count.clamp(min=1)[:, None], views=count)


def _projected(
    points: Float[Tensor, "point 3"], view: ObjectView
) -> tuple[Float[Tensor, "point 2"], Bool[Tensor, " point"]]:
    """Projections in -1..1 over the image, and whether they are inside and in front of the camera."""
    T, K = (torch.from_numpy(matrix).to(points) for matrix in (view.T_cam_from_canonical, view.K))
    points_cam = points @ T[:3, :3].T + T[:3, 3]
    in_front = points_cam[:, 2] > 0
    homogeneous = points_cam @ K.T
    pixels = homogeneous[:, :2] / torch.where(in_front, homogeneous[:, 2], 1.0)[:, None]
    at = 2.0 * pixels / view.image.shape[0] - 1.0
    return at, in_front & (at.abs() <= 1.0).all(dim=1)
