"""Corners of the active voxels: shared ones averaged, the others given a side."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int, Int32
from scipy import ndimage

from model.surface.fields import CORNERS, SurfaceFields

__all__ = ["LARGEST_MOVE", "CornerLattice", "SignedLattice", "corner_lattice", "fill_uncovered"]

# TRELLIS lets corners move by (1 - 1e-8) of half a cell, which float32 rounds to 1: two neighbours may then meet.
LARGEST_MOVE = 0.5 * (1.0 - 1e-3)


@dataclass(frozen=True, kw_only=True)
class CornerLattice:
    """The lattice of voxel corners, cut to the active voxels and a margin; sparse values, dense lookup."""

    resolution: int
    origin: Int[np.ndarray, "3"]  # lattice coordinate of element (0, 0, 0); 0 is the cube's side at -0.5
    row: Int32[np.ndarray, "x y z"]  # row of a corner in the arrays below, -1 where no active voxel has it
    distances: Float32[np.ndarray, " corner"]  # negative inside
    positions: Float32[np.ndarray, "corner 3"]  # canonical, deformed
    colors: Float32[np.ndarray, "corner 3"]  # sRGB, 0..1


@dataclass(frozen=True, kw_only=True)
class SignedLattice:
    """A side for every corner of a lattice, covered or not."""

    inside: Bool[np.ndarray, "x y z"]
    # Corners said to be inside next to uncovered ones that are outside: the voxels leave the mesh open there.
    exposed_corners: int


def corner_lattice(fields: SurfaceFields, margin: int) -> CornerLattice:
    """Averages every corner over the active voxels that share it; `margin` empty layers are put around."""
    voxels = fields.voxels.astype(np.int64)
    origin = voxels.min(axis=0) - margin
    shape = tuple(voxels.max(axis=0) + 2 + margin - origin)
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    first = (voxels - origin) @ strides
    steps = CORNERS @ strides

    row = np.full(int(np.prod(shape)), -1, dtype=np.int32)
    for step in steps:
        row[first + step] = 0
    flat = np.flatnonzero(row == 0)
    row[flat] = np.arange(len(flat), dtype=np.int32)

    share = np.zeros(len(flat))
    sums = np.zeros((7, len(flat)))
    for c, step in enumerate(steps):
        rows = row[first + step]
        share += np.bincount(rows, minlength=len(flat))
        columns = (fields.distances[:, c], *fields.deformations[:, c].T, *fields.color_logits[:, c].T)
        for k, column in enumerate(columns):
            sums[k] += np.bincount(rows, column, minlength=len(flat))
    means = sums / share

    lattice_points = np.stack(np.unravel_index(flat, shape), axis=1) + origin
    moved = lattice_points + LARGEST_MOVE * np.tanh(means[1:4].T)
    return CornerLattice(
        resolution=fields.resolution,
        origin=origin,
        row=row.reshape(shape),
        distances=means[0].astype(np.float32),
        positions=(moved / fields.resolution - 0.5).astype(np.float32),
        colors=(0.5 + 0.5 * np.tanh(0.5 * means[4:7].T)).astype(np.float32),
    )


def fill_uncovered(lattice: CornerLattice, seal: int) -> SignedLattice:
    """Corners that no active voxel has: outside where the outside reaches them, else the side of what encloses them.

    Active voxels are a thin shell around a surface. TRELLIS calls every other corner outside (+1), so its meshes have
    a second, inner surface; here the space that a shell encloses takes the side that most of the covered corners
    around it have, and the shell becomes one watertight mesh (or keeps a cavity, where the shell says so). `seal`: gaps
    of up to 2 seal corners in the shell do not let the outside in; the lattice needs a margin of at least seal + 1.
    """
    covered = lattice.row >= 0
    inside = np.zeros(covered.shape, dtype=bool)
    inside[covered] = lattice.distances[lattice.row[covered]] < 0.0

    barrier = ndimage.maximum_filter(covered, size=2 * seal + 1) if seal else covered
    regions = np.empty(covered.shape, dtype=np.int32)
    count = ndimage.label(~barrier, output=regions)
    _grow(regions, covered)
    rest = np.empty_like(regions)
    extra = ndimage.label((regions == 0) & ~covered, output=rest)
    np.add(rest, count, out=regions, where=rest > 0)

    votes = _votes(regions, covered, inside, count + extra + 1)
    outside_region = regions[0, 0, 0]
    exposed = int(votes.inside[outside_region])
    region_inside = votes.inside > votes.outside
    region_inside[[0, outside_region]] = False
    inside |= region_inside[regions]
    return SignedLattice(inside=inside, exposed_corners=exposed)


@dataclass(frozen=True, kw_only=True)
class _Votes:
    inside: Int[np.ndarray, " region"]
    outside: Int[np.ndarray, " region"]


def _grow(regions: Int32[np.ndarray, "x y z"], covered: Bool[np.ndarray, "x y z"]) -> None:
    """Regions take, layer by layer, the uncovered corners between them and the covered ones; in place."""
    flat = regions.reshape(-1)
    strides = (regions.shape[1] * regions.shape[2], regions.shape[2], 1)
    waiting = np.flatnonzero((flat == 0) & ~covered.reshape(-1))  # never in the outermost layer
    while len(waiting):
        found = np.zeros(len(waiting), dtype=np.int32)
        for stride in strides:
            np.maximum(found, flat[waiting - stride], out=found)
            np.maximum(found, flat[waiting + stride], out=found)
        if not found.any():
            return
        flat[waiting] = found
        waiting = waiting[found == 0]


def _votes(
    regions: Int32[np.ndarray, "x y z"],
    covered: Bool[np.ndarray, "x y z"],
    inside: Bool[np.ndarray, "x y z"],
    count: int,
) -> _Votes:
    """How many (uncovered, covered) neighbours each region has, by the covered one's side."""
    ayes, noes = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    flat_regions, flat_inside = regions.reshape(-1), inside.reshape(-1)
    flat_covered = covered.reshape(-1)
    edge = np.flatnonzero(flat_covered)  # never in the outermost layer
    for stride in (covered.shape[1] * covered.shape[2], covered.shape[2], 1):
        for step in (-stride, stride):
            beside = edge[~flat_covered[edge + step]]
            region, says = flat_regions[beside + step], flat_inside[beside]
            ayes += np.bincount(region[says], minlength=count)
            noes += np.bincount(region[~says], minlength=count)
    return _Votes(inside=ayes, outside=noes)
