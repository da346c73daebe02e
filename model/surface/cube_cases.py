"""Triangles of a cube for each of the 256 patterns of inside corners; built from a rule, not from a published table.

On each face of the cube, walked counter-clockwise as seen from outside, every run of *outside* corners is cut off by
one segment. The rule looks at the face's four corners only, so the two cubes that share a face draw the same segments,
once in each direction: the surface has no gaps. Each crossed edge is entered by one face and left by the other, so the
segments close to loops. Loops become triangles without any diagonal between edges of one face: such a diagonal could
be drawn by the neighbour too. Hence, for any pattern of corners, every triangle side has exactly two triangles and
the triangles around a vertex (one crossed edge, four cubes) form one ring: a closed manifold.
"""

from collections.abc import Iterator
from itertools import product

import numpy as np
from jaxtyping import Int

from model.surface.fields import CORNERS

__all__ = ["EDGES", "edge_loops", "triangle_table"]

# (lower corner, upper corner, axis) of the 12 edges.
EDGES = tuple((c, c | 1 << axis, axis) for axis in range(3) for c in range(8) if not c >> axis & 1)
_EDGE_OF = {frozenset(edge[:2]): index for index, edge in enumerate(EDGES)}


def _face_corners() -> tuple[tuple[int, ...], ...]:
    """Corners of the six faces, counter-clockwise as seen from outside."""
    faces = []
    for axis, side in product(range(3), (0, 1)):
        u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        ring = (0, u, u | v, v) if side else (0, v, u | v, u)
        faces.append(tuple((side << axis) | corner for corner in ring))
    return tuple(faces)


_FACES = _face_corners()
_EDGE_FACES = tuple({f for f, face in enumerate(_FACES) if set(edge[:2]) <= set(face)} for edge in EDGES)


def edge_loops(case: int) -> list[list[int]]:
    """Closed loops of crossed edges, counter-clockwise seen from outside; bit c of `case` is corner c."""
    following: dict[int, int] = {}
    for face in _FACES:
        crossed = [
            (_EDGE_OF[frozenset((a, b))], bool(case >> b & 1))
            for a, b in zip(face, face[1:] + face[:1])
            if (case >> a & 1) != (case >> b & 1)
        ]
        for (edge, enters), (next_edge, _) in zip(crossed, crossed[1:] + crossed[:1]):
            if not enters:
                following[next_edge] = edge
    loops = []
    while following:
        loop = [min(following)]
        while (edge := following.pop(loop[-1])) != loop[0]:
            loop.append(edge)
        loops.append(loop)
    return loops


def _triangulations(loop: list[int]) -> Iterator[list[tuple[int, int, int]]]:
    """All ways to cut a loop into triangles without a diagonal between two edges of one face."""
    if len(loop) == 2:
        yield []
        return
    for k in range(1, len(loop) - 1):
        halves = loop[: k + 1], loop[k:]
        if any(len(half) > 2 and _EDGE_FACES[half[0]] & _EDGE_FACES[half[-1]] for half in halves):
            continue
        for first, second in product(*(list(_triangulations(half)) for half in halves)):
            yield [*first, (loop[0], loop[k], loop[-1]), *second]


def _length(triangles: list[tuple[int, int, int]]) -> float:
    """Sum of the triangles' sides with every crossing in the middle of its edge: short is well-shaped."""
    middle = np.array([0.5 * (CORNERS[a] + CORNERS[b]) for a, b, _ in EDGES])
    points = middle[np.array(triangles)]
    return float(np.linalg.norm(points - np.roll(points, 1, axis=1), axis=2).sum())


def triangle_table() -> Int[np.ndarray, "256 5 3"]:
    """Edge numbers of up to five triangles per case, -1 where there are fewer."""
    table = np.full((256, 5, 3), -1)
    for case in range(256):
        triangles = [
            triangle for loop in edge_loops(case) for triangle in min(_triangulations(loop), key=_length)
        ]
        table[case, : len(triangles)] = np.array(triangles).reshape(-1, 3)
    return table
