"""The fingerprint of a surface: equal for copies of one object in another format, unit, position, turn or mirror.

Made of moments of the area alone, which are integrated exactly: how the surface is cut into
triangles, and in which order they come, does not count.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.objects.mesh.object_mesh import ObjectMesh
from datagen.objects.mesh.surface_points import SurfaceSamples, face_areas

__all__ = ["Fingerprint", "fingerprint_of"]

# Weights and barycentric coordinates that integrate polynomials of degree 6 over a triangle exactly
# (Dunavant, Int. J. Numer. Methods Eng. 21, 1985, rule of 12 points).
_RULE = (
    *((0.116786275726379, np.roll((0.501426509658179, 0.249286745170910, 0.249286745170910), k)) for k in range(3)),
    *((0.050844906370207, np.roll((0.873821971016996, 0.063089014491502, 0.063089014491502), k)) for k in range(3)),
    *((0.082851075618374, np.roll((0.053145049844817, 0.310352451033784, 0.636502499121399), k)) for k in range(3)),
    *((0.082851075618374, np.roll((0.053145049844817, 0.636502499121399, 0.310352451033784), k)) for k in range(3)),
)  # fmt: skip
_FIRST, _SECOND = (
    np.array([0, 1, 2, 0, 0, 1]),
    np.array([0, 1, 2, 1, 2, 2]),
)  # the products xx, yy, zz, xy, xz, yz
_TIMES = np.array([1, 1, 1, 2, 2, 2])  # that each of them is in a symmetric matrix


@dataclass(frozen=True, kw_only=True)
class Fingerprint:
    """What tells a surface from others.

    `shape` has 14 numbers about the moments of the points x of the area around its centre, in units
    of `size_m`: roots of the eigenvalues of the means of x xᵀ, |x|² x xᵀ and |x|⁴ x xᵀ, then of the
    means of |x|⁴ and |x|⁶, the length of the mean of |x|² x, and the norms of all third and fourth
    moments. None changes under turns and mirroring.
    """

    shape: tuple[float, ...]
    size_m: float  # root mean square distance of the surface to its centre of area
    color: tuple[float, float, float]  # mean of the surface, sRGB 0..1


@dataclass(frozen=True, kw_only=True)
class _Moments:
    """Means over the area, of points in units of their root mean square distance to the centre."""

    third: Float[np.ndarray, "6 3"]  # products of two coordinates by coordinates
    fourth: Float[np.ndarray, "6 6"]  # products by products
    sixth: Float[np.ndarray, " 6"]  # |x|^4 times products


def fingerprint_of(mesh: ObjectMesh, samples: SurfaceSamples) -> Fingerprint:
    """Of a mesh; `samples` are points spread evenly over its area, whose colours count. Deterministic."""
    corners = mesh.verts_obj[mesh.faces]
    share = face_areas(mesh.verts_obj, mesh.faces)
    share = share / share.sum()
    corners = corners - share @ corners.mean(axis=1)
    spread = _matrix(sum(weight * share @ _products(corners, at) for weight, at in _RULE))
    size_m = float(np.sqrt(np.trace(spread)))
    red, green, blue = samples.colors.mean(axis=0)
    return Fingerprint(
        shape=_invariants(spread / size_m**2, _moments(corners / size_m, share)),
        size_m=size_m,
        color=(float(red), float(green), float(blue)),
    )


def _invariants(spread: Float[np.ndarray, "3 3"], moments: _Moments) -> tuple[float, ...]:
    fourth = _matrix(moments.fourth[:3].sum(axis=0))  # mean of |x|^2 x x^T
    sixth = _matrix(moments.sixth)
    lengths = [
        *_eigenvalues(spread) ** (1 / 2),
        *_eigenvalues(fourth) ** (1 / 4),
        *_eigenvalues(sixth) ** (1 / 6),
        np.trace(fourth) ** (1 / 4),
        np.trace(sixth) ** (1 / 6),
        # Not their roots: these are 0 for symmetric shapes, where a root would enlarge what is nearly 0.
        np.linalg.norm(moments.third[:3].sum(axis=0)),
        np.sqrt((_TIMES[:, None] * moments.third**2).sum()),
        (_TIMES[:, None] * _TIMES * moments.fourth**2).sum() ** (1 / 8),
    ]
    return tuple(float(length) for length in lengths)


def _moments(corners: Float[np.ndarray, "face 3 3"], share: Float[np.ndarray, " face"]) -> _Moments:
    third, fourth, sixth = np.zeros((6, 3)), np.zeros((6, 6)), np.zeros(6)
    for weight, at in _RULE:
        points = at @ corners
        products = points[:, _FIRST] * points[:, _SECOND]
        weighted = (weight * share)[:, None] * products
        third += weighted.T @ points
        fourth += weighted.T @ products
        sixth += (products[:, :3].sum(axis=1) ** 2) @ weighted
    return _Moments(third=third, fourth=fourth, sixth=sixth)


def _products(
    corners: Float[np.ndarray, "face 3 3"], at: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "face 6"]:
    points = at @ corners
    return points[:, _FIRST] * points[:, _SECOND]


def _matrix(products: Float[np.ndarray, " 6"]) -> Float[np.ndarray, "3 3"]:
    matrix = np.zeros((3, 3))
    matrix[_FIRST, _SECOND] = matrix[_SECOND, _FIRST] = products
    return matrix


def _eigenvalues(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """Ascending; rounding below 0 is 0."""
    return np.maximum(np.linalg.eigvalsh(matrix), 0.0)
