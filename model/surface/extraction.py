"""Marching cubes over the corners of the active voxels: closed and manifold for any numbers a decoder may emit."""

from dataclasses import dataclass
from functools import cache
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float32, Int, Int32, Int64
from scipy.spatial import KDTree

from model.errors import ModelError
from model.surface.cube_cases import EDGES, triangle_table
from model.surface.fields import CORNERS, SurfaceFields
from model.surface.lattice import CornerLattice, SignedLattice, corner_lattice, fill_uncovered
from model.surface.mesh import SurfaceMesh
from shards.settings import Range

__all__ = ["ExtractedSurface", "ExtractionConfig", "extract_surface"]

# Crossings keep this share of an edge away from its ends: a distance of exactly 0 would give triangles without area.
_END_SHARE = 0.005


@dataclass(frozen=True, kw_only=True)
class ExtractionConfig:
    """How a surface is taken from decoded voxels."""

    # corners; gaps of up to twice as many in the shell of active voxels are closed
    seal: Annotated[int, Range(0, 100)]


@dataclass(frozen=True, kw_only=True)
class ExtractedSurface:
    """The mesh, and what had to be assumed for it."""

    mesh: SurfaceMesh
    exposed_corners: int  # said to be inside, though only uncovered outside lies beside them
    uncolored_vertices: int  # between uncovered corners: they have the colour of the nearest other vertex


@dataclass(frozen=True, kw_only=True)
class _Crossings:
    """Lattice edges from an inside corner to an outside one; both as flat element numbers of the lattice."""

    keys: Int64[np.ndarray, " vertex"]  # 3 x lower corner + axis, ascending
    inner: Int64[np.ndarray, " vertex"]
    outer: Int64[np.ndarray, " vertex"]


def extract_surface(fields: SurfaceFields, config: ExtractionConfig) -> ExtractedSurface:
    """The closed surface between inside (distance < 0) and outside, canonical frame, outward.

    Shapes that reach beyond the cube are cut off at its sides. FlexiCubes weights are not used (fields.py says why).
    ModelError: nothing is inside.
    """
    lattice = corner_lattice(fields, margin=config.seal + 1)
    signed = fill_uncovered(lattice, config.seal)
    if not signed.inside.any():
        raise ModelError(
            "surface extraction",
            f"no corner of {len(fields.voxels)} active voxels is inside",
            expected="negative distances somewhere",
            action="Check that the decoder is trained and that its distances are negative inside.",
        )
    crossings = _crossings(signed.inside)
    vertices, colors, uncolored = _place_vertices(lattice, crossings)
    faces = _faces(signed, crossings)
    return ExtractedSurface(
        mesh=SurfaceMesh(vertices=vertices, faces=faces, colors=colors),
        exposed_corners=signed.exposed_corners,
        uncolored_vertices=uncolored,
    )


@cache
def _triangles() -> Int[np.ndarray, "256 5 3"]:
    return triangle_table()


def _crossings(inside: Bool[np.ndarray, "x y z"]) -> _Crossings:
    strides = (inside.shape[1] * inside.shape[2], inside.shape[2], 1)
    flat = inside.reshape(-1)
    keys, inner, outer = [], [], []
    for axis, stride in enumerate(strides):
        # Runs over row ends too, where both corners are outside by the margin.
        lower = np.flatnonzero(flat[:-stride] != flat[stride:])
        lower_is_inside = flat[lower]
        keys.append(3 * lower + axis)
        inner.append(np.where(lower_is_inside, lower, lower + stride))
        outer.append(np.where(lower_is_inside, lower + stride, lower))
    all_keys = np.concatenate(keys)
    order = np.argsort(all_keys)
    return _Crossings(
        keys=all_keys[order], inner=np.concatenate(inner)[order], outer=np.concatenate(outer)[order]
    )


def _place_vertices(
    lattice: CornerLattice, crossings: _Crossings
) -> tuple[Float32[np.ndarray, "vertex 3"], Float32[np.ndarray, "vertex 3"], int]:
    """Positions, colours, and how many vertices had no colour of their own."""
    row = lattice.row.reshape(-1)
    row_in, row_out = row[crossings.inner], row[crossings.outer]
    known_in, known_out = row_in >= 0, row_out >= 0
    both = known_in & known_out
    outer_points = _lattice_points(lattice, crossings.outer)

    d_in, d_out = lattice.distances[row_in[both]], lattice.distances[row_out[both]]
    share = np.full(len(row_in), 0.5, dtype=np.float32)
    share[both] = d_in / (d_in - d_out)
    beyond = ((outer_points < 0) | (outer_points > lattice.resolution)).any(axis=1)
    share[beyond] = 0.0
    share = np.clip(share, _END_SHARE, 1.0 - _END_SHARE)[:, None]

    ends, colors = [], []
    for points, rows, known in (
        (_lattice_points(lattice, crossings.inner), row_in, known_in),
        (outer_points, row_out, known_out),
    ):
        position = (points / lattice.resolution - 0.5).astype(np.float32)
        position[known] = lattice.positions[rows[known]]
        ends.append(position)
        colors.append(lattice.colors[rows])  # row -1 is replaced below
    color = colors[0] + share * (colors[1] - colors[0])
    color[~known_out] = colors[0][~known_out]
    color[~known_in] = colors[1][~known_in]
    uncolored = ~(known_in | known_out)
    vertices = ends[0] + share * (ends[1] - ends[0])
    if uncolored.any() and not uncolored.all():
        nearest = KDTree(vertices[~uncolored]).query(vertices[uncolored])[1]
        color[uncolored] = color[~uncolored][nearest]
    return vertices, color, int(np.count_nonzero(uncolored))


def _lattice_points(
    lattice: CornerLattice, flat: Int64[np.ndarray, " vertex"]
) -> Int64[np.ndarray, "vertex 3"]:
    return np.stack(np.unravel_index(flat, lattice.row.shape), axis=1) + lattice.origin


def _faces(signed: SignedLattice, crossings: _Crossings) -> Int32[np.ndarray, "face 3"]:
    inside = signed.inside
    strides = np.array([inside.shape[1] * inside.shape[2], inside.shape[2], 1])
    bits = inside.view(np.uint8).reshape(-1)
    steps = CORNERS @ strides
    # Every cell with both kinds of corner has a crossed edge, so only the cells around crossed edges are looked at.
    lower, axis = np.divmod(crossings.keys, 3)
    touched = np.zeros(len(bits), dtype=bool)
    for k in range(3):
        along = lower[axis == k]
        u, v = np.delete(strides, k)
        for step in (0, u, v, u + v):
            touched[along - step] = True
    cells = np.flatnonzero(touched)
    case = np.zeros(len(cells), dtype=np.uint8)
    for c, step in enumerate(steps):
        case |= bits[cells + step] << c
    triangles = _triangles()[case]
    cell_of, slot = np.nonzero(triangles[:, :, 0] >= 0)
    edge_steps = np.array([3 * steps[a] + axis for a, _, axis in EDGES])
    keys = 3 * cells[cell_of][:, None] + edge_steps[triangles[cell_of, slot]]
    return np.searchsorted(crossings.keys, keys).astype(np.int32)
