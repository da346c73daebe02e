"""A decoder's lattice of corners as a field that can be asked anywhere inside the active voxels; differentiable.

The same lattice as `model.surface.lattice` extracts from: corners shared by active voxels are averaged, then moved by
half a cell times tanh of their deformation. Inside a deformed cell, position, distance and colour are trilinear in the
cell's own coordinates; a point finds its coordinates by u = u0 - offset(u), which a few rounds solve.

Distances are measured in cells of the decoded grid, so a trained decoder emits numbers around one.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from model.networks.sparse.grid import SparseGrid
from model.networks.sparse.tensor import SparseTensor
from model.surface.fields import CORNERS, split_channels
from model.surface.lattice import LARGEST_MOVE

__all__ = ["DecodedLattice", "FieldSamples", "decoded_lattice"]

_ROUNDS = 4  # of the fixed point; offsets of neighbouring corners differ by far less than a cell


@dataclass(frozen=True, kw_only=True, eq=False)
class FieldSamples:
    """The field at the points that lie in an active voxel."""

    inside: Bool[Tensor, " point"]  # which of the points asked for; the rest of the fields has these only
    distance: Float[Tensor, " inside"]  # cells, negative inside
    color: Float[Tensor, "inside 3"]  # sRGB, 0..1
    # Rows of d distance / du and of d position / du, u the cell's own coordinates; lengths in cells.
    slope: Float[Tensor, "inside 3"]
    jacobian: Float[Tensor, "inside 3 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class DecodedLattice:
    """Averaged corner values of a decoded batch."""

    grid: SparseGrid
    corner_of_voxel: Int[Tensor, "voxel 8"]
    distances: Float[Tensor, " corner"]  # cells, negative inside
    offsets: Float[Tensor, "corner 3"]  # cells, each less than a half
    colors: Float[Tensor, "corner 3"]  # sRGB, 0..1

    def at(self, points: Float[Tensor, "point 3"], sample: Int[Tensor, " point"]) -> FieldSamples:
        """The field at canonical points of the samples of that number."""
        start = (points + 0.5) * self.grid.resolution
        row = self._rows(start, sample)
        inside = row >= 0
        start, sample, row = start[inside], sample[inside], row[inside]
        with torch.no_grad():
            u = start
            for _ in range(_ROUNDS):
                u = start - self._mix(self.offsets, row, u)
                found = self._rows(u, sample)
                row = torch.where(found >= 0, found, row)
        # Once more with gradients, which the fixed point's own derivative would scale by almost one.
        u = start - self._mix(self.offsets, row, u)
        corners = self.corner_of_voxel[row]
        weights, slopes = _trilinear(u - self.grid.coordinates[row])
        distances, offsets = self.distances[corners], self.offsets[corners]
        eye = torch.eye(3, dtype=u.dtype, device=u.device)
        return FieldSamples(
            inside=inside,
            distance=(weights * distances).sum(1),
            color=torch.einsum("pc,pcx->px", weights, self.colors[corners]),
            slope=torch.einsum("pcu,pc->pu", slopes, distances),
            jacobian=eye + torch.einsum("pcu,pcx->pxu", slopes, offsets),
        )

    def _mix(
        self, values: Float[Tensor, "corner 3"], row: Int[Tensor, " point"], u: Float[Tensor, "point 3"]
    ) -> Float[Tensor, "point 3"]:
        weights, _ = _trilinear(u - self.grid.coordinates[row])
        return torch.einsum("pc,pcx->px", weights, values[self.corner_of_voxel[row]])

    def _rows(self, u: Float[Tensor, "point 3"], sample: Int[Tensor, " point"]) -> Int[Tensor, " point"]:
        """Row of the active voxel around a point in lattice coordinates, -1 where there is none."""
        resolution, keys = self.grid.resolution, self.grid.keys
        if not len(keys):
            return torch.full_like(sample, -1)
        i, j, k = u.detach().floor().long().clamp(0, resolution - 1).unbind(1)
        key = ((sample * resolution + i) * resolution + j) * resolution + k
        row = torch.searchsorted(keys, key).clamp(max=len(keys) - 1)
        return torch.where(keys[row] == key, row, -1)


def decoded_lattice(decoded: SparseTensor) -> DecodedLattice:
    """Corners of a surface decoder's output, shared ones averaged; float32."""
    named = split_channels(decoded.features.float(), decoded.grid.resolution)
    corner_of_voxel, share = decoded.grid.derived("corners", lambda: _corners(decoded.grid))
    values = torch.cat([named.distances[..., None], named.deformations, named.color_logits], dim=2)
    total = values.new_zeros(len(share), 7).index_add(0, corner_of_voxel.flatten(), values.flatten(0, 1))
    mean = total / share[:, None]
    return DecodedLattice(
        grid=decoded.grid,
        corner_of_voxel=corner_of_voxel,
        distances=mean[:, 0],
        offsets=LARGEST_MOVE * torch.tanh(mean[:, 1:4]),
        colors=torch.sigmoid(mean[:, 4:]),
    )


def _corners(grid: SparseGrid) -> tuple[Int[Tensor, "voxel 8"], Int[Tensor, " corner"]]:
    """Number of each voxel's corners, and how many voxels share each corner."""
    side = grid.resolution + 1
    steps = torch.as_tensor(CORNERS, device=grid.device)
    i, j, k = (grid.coordinates[:, None] + steps).unbind(2)
    keys = ((grid.batch_index[:, None] * side + i) * side + j) * side + k
    _, corner, share = keys.flatten().unique(return_inverse=True, return_counts=True)
    return corner.view(-1, 8), share


def _trilinear(
    f: Float[Tensor, "point 3"],
) -> tuple[Float[Tensor, "point 8"], Float[Tensor, "point 8 3"]]:
    """Weights of a cell's corners at its coordinates f, 0..1 inside, and their derivatives along the axes."""
    bits = torch.as_tensor(CORNERS, device=f.device).to(f.dtype)
    along = f[:, None] * (2 * bits - 1) + (1 - bits)  # f where the corner is the upper one, else 1 - f
    x, y, z = along.unbind(2)
    slopes = torch.stack([y * z, x * z, x * y], dim=2) * (2 * bits - 1)
    return x * y * z, slopes
