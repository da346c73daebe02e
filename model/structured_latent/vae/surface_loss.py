"""Loss of the SLat VAE without rendering: the decoded field against the samples of the true surface.

    distance     |d(q) - s| at signed-distance samples inside active voxels, both within `truncation`
    surface      |d(p)| at surface points
    normal       |dd/du - J^T n|^2 at surface points, J = dx/du: the field's gradient in space is the normal
    corner       |d(c) - estimate| at the corners of the latent grid, estimates from `corner_distances`
    color        |c(p) - color| at surface points, sRGB
    deformation  mean square of the corners' moves, cells
    kl           of the latents to N(0, 1), mean per element

Lengths are in cells of the decoded grid (`surface_lattice`). Each term is a mean per sample, so that a bad sample can
be named and ranks that share a batch agree with one process.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Annotated

import torch
from jaxtyping import Float, Int
from torch import Tensor

from model.data.batch import SurfaceBatch
from model.networks.sparse.grid import SparseGrid
from model.networks.sparse.tensor import SparseTensor
from model.structured_latent.vae.latent import SlatDistribution
from model.structured_latent.vae.surface_lattice import DecodedLattice, decoded_lattice
from model.surface.fields import CORNERS
from shards.settings import Range

__all__ = ["SurfaceLoss", "SurfaceLossConfig", "surface_loss"]


@dataclass(frozen=True, kw_only=True)
class SurfaceLossConfig:
    """Weights of the terms."""

    distance: Annotated[float, Range(0, 1e6)]
    surface: Annotated[float, Range(0, 1e6)]
    normal: Annotated[float, Range(0, 1e6)]
    corner: Annotated[float, Range(0, 1e6)]
    color: Annotated[float, Range(0, 1e6)]
    deformation: Annotated[float, Range(0, 1e6)]
    kl: Annotated[float, Range(0, 1e6)]
    truncation: Annotated[float, Range(1e-3, 1e3)]  # voxels of the latent grid


@dataclass(frozen=True, kw_only=True)
class SurfaceLoss:
    """The terms per sample, unweighted."""

    distance: Float[Tensor, " batch"]
    surface: Float[Tensor, " batch"]
    normal: Float[Tensor, " batch"]
    corner: Float[Tensor, " batch"]
    color: Float[Tensor, " batch"]
    deformation: Float[Tensor, " batch"]
    kl: Float[Tensor, " batch"]

    def weighted(self, config: SurfaceLossConfig) -> Float[Tensor, " batch"]:
        """What is minimised, per sample."""
        terms = [getattr(config, f.name) * getattr(self, f.name) for f in fields(self)]
        return torch.stack(terms).sum(0)


def surface_loss(
    decoded: SparseTensor,
    latent: SlatDistribution,
    truth: SurfaceBatch,
    corner_estimates: Float[Tensor, "voxel 8"],
    config: SurfaceLossConfig,
) -> SurfaceLoss:
    """Terms of a batch. `corner_estimates`: signed distance at the corners of the latent's voxels, in such voxels.

    A sample without samples in active voxels has zero in the terms that need them. In float32 under autocast too:
    bfloat16 would hold a place in the lattice to half a cell.
    """
    with torch.autocast(decoded.features.device.type, enabled=False):
        return _terms(decoded, latent, truth, corner_estimates, config)


def _terms(
    decoded: SparseTensor,
    latent: SlatDistribution,
    truth: SurfaceBatch,
    corner_estimates: Float[Tensor, "voxel 8"],
    config: SurfaceLossConfig,
) -> SurfaceLoss:
    lattice = decoded_lattice(decoded)
    coarse = latent.mean.grid
    cells = decoded.grid.resolution / coarse.resolution  # per voxel of the latent grid
    batch = coarse.batch_size
    limit = config.truncation * cells

    of_sdf = _sample_of_rows(truth.sdf_counts, truth.sdf_points.device)
    field = lattice.at(truth.sdf_points, of_sdf)
    values = (truth.sdf_values[field.inside] * decoded.grid.resolution).clamp(-limit, limit)
    distance = (_within(field.distance, limit) - values).abs()

    of_point = _sample_of_rows(truth.point_counts, truth.points.device)
    at_points = lattice.at(truth.points, of_point)
    on_surface = of_point[at_points.inside]
    normals = truth.normals[at_points.inside]
    tilt = at_points.slope - torch.einsum("pxu,px->pu", at_points.jacobian, normals)
    wrong_color = at_points.color - truth.colors[at_points.inside].float() / 255.0

    corners = lattice.distances[_coarse_corners(lattice, coarse)]
    known = (corner_estimates * cells).clamp(-limit, limit)
    mean, logvar = latent.mean.features.float(), latent.logvar.features.float()
    kl = 0.5 * (mean.square() + logvar.exp() - logvar - 1).mean(1)
    moves = lattice.offsets.square().sum(1)[lattice.corner_of_voxel].mean(1)
    return SurfaceLoss(
        distance=_means(distance, of_sdf[field.inside], batch),
        surface=_means(at_points.distance.abs(), on_surface, batch),
        normal=_means(tilt.square().sum(1), on_surface, batch),
        corner=_means((_within(corners, limit) - known).abs().mean(1), coarse.batch_index, batch),
        color=_means(wrong_color.abs().mean(1), on_surface, batch),
        deformation=_means(moves, decoded.grid.batch_index, batch),
        kl=_means(kl, coarse.batch_index, batch),
    )


def _within(distance: Float[Tensor, "*shape"], limit: float) -> Float[Tensor, "*shape"]:
    """Clamped as the truth is, but with a slope beyond, so that a value on the wrong side finds back."""
    return distance - 0.9 * (distance - distance.clamp(-limit, limit))


def _sample_of_rows(counts: Sequence[int], device: torch.device) -> Int[Tensor, " row"]:
    return torch.arange(len(counts), device=device).repeat_interleave(torch.tensor(counts, device=device))


def _means(values: Float[Tensor, " row"], sample: Int[Tensor, " row"], batch: int) -> Float[Tensor, " batch"]:
    total = values.new_zeros(batch).index_add(0, sample, values)
    return total / sample.bincount(minlength=batch).clamp(min=1)


def _coarse_corners(lattice: DecodedLattice, coarse: SparseGrid) -> Int[Tensor, "voxel 8"]:
    """The lattice corners that are corners of the latent grid's voxels."""
    fine = lattice.grid
    cells = fine.resolution // coarse.resolution
    bits = torch.as_tensor(CORNERS, device=fine.device)
    # Corner c of a voxel is corner c of the child that lies there.
    child = cells * coarse.coordinates[:, None] + (cells - 1) * bits
    i, j, k = child.unbind(2)
    resolution = fine.resolution
    keys = ((coarse.batch_index[:, None] * resolution + i) * resolution + j) * resolution + k
    rows = torch.searchsorted(fine.keys, keys)
    return lattice.corner_of_voxel.gather(0, rows)
