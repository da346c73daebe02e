"""Finding a model again in a copy that was turned, rescaled, decimated and closed.

GraspXL's meshes are such copies of Objaverse models. Which axes they were turned to is not
documented, so all 24 turns by right angles are tried: first by the proportions of the bounding
box, then by the distances between the surfaces; the similarity is then refined by ICP.
"""

from dataclasses import dataclass
from itertools import permutations, product
from typing import Annotated

import igl
import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.objects.errors import ObjectError
from datagen.objects.mesh.outward_faces import ray_intersector
from datagen.objects.mesh.surface_points import face_areas, face_normals
from shards.settings import Range

__all__ = ["REFERENCE_REGISTRATION", "Registration", "RegistrationConfig", "axis_rotations", "register"]

# x_turned = TURN_TO_Y_UP @ x: takes back the turn of glTF's Y-up axes to Z-up.
TURN_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
N_VIEW_RAYS = 24  # per point and side: who sees the point from outside
SEEN_SHARE = 0.10  # of those rays; a point inside a shell is seen through a slit by fewer
EXACT = 1e-5  # distances / diagonal below this are rounding
ICP_KEPT_SHARE = 0.9  # farther pairs are caps over holes, or parts that the copy lost


@dataclass(frozen=True, kw_only=True)
class RegistrationConfig:
    """How surfaces are compared and what is refused."""

    n_points: Annotated[int, Range(10, 1_000_000)]  # per surface
    icp_steps: Annotated[int, Range(0, 10_000)]
    # of the bbox sides after one common scale / diagonal of the rescaled mesh
    max_size_error: Annotated[float, Range(0, 10)]
    # 95th percentile of the surface distance / diagonal of the rescaled mesh
    max_residual: Annotated[float, Range(0, 10)]
    # mean distances up to this factor apart are a tie (symmetric objects)
    equally_good: Annotated[float, Range(1, 100)]


REFERENCE_REGISTRATION = RegistrationConfig(
    n_points=1500, icp_steps=8, max_size_error=0.03, max_residual=0.02, equally_good=1.2
)


@dataclass(frozen=True, kw_only=True)
class Registration:
    """Where the original lies in the frame of the rescaled copy, and how well it fits.

    Distances are in metres of the rescaled frame. Of the original only points that can be seen
    from outside count: a closed copy has no inner walls.
    """

    T_rescaled_from_original: Float[np.ndarray, "4 4"]  # x_rescaled = T @ x_original; a similarity
    axis_rotation: Float[np.ndarray, "3 3"]  # the turn by right angles that it started from
    scale: float
    size_error: float  # of the bbox sides after one common scale / diagonal; anisotropic copies: large
    original_to_rescaled_mean_m: float
    original_to_rescaled_p95_m: float
    rescaled_to_original_mean_m: float
    rescaled_to_original_p95_m: float
    residual: float  # the larger of the two 95th percentiles / diagonal of the rescaled bbox


class _Surface:
    """Triangles with points on them and a search tree."""

    def __init__(self, verts: Float[np.ndarray, "vert 3"], faces: Int[np.ndarray, "face 3"]) -> None:
        self.verts = np.ascontiguousarray(verts, dtype=np.float64)
        self.faces = np.ascontiguousarray(faces, dtype=np.int64)
        used = self.verts[np.unique(self.faces)]
        self.low, self.high = used.min(axis=0), used.max(axis=0)
        self._tree = igl.AABB()
        self._tree.init(self.verts, self.faces)

    @property
    def size(self) -> Float[np.ndarray, "3"]:
        return self.high - self.low

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        return 0.5 * (self.low + self.high)

    def nearest(
        self, points: Float[np.ndarray, "point 3"]
    ) -> tuple[Float[np.ndarray, " point"], Float[np.ndarray, "point 3"]]:
        """Distance to the surface, and the nearest point on it."""
        squared, _, nearest = self._tree.squared_distance(
            self.verts, self.faces, np.ascontiguousarray(points)
        )
        return np.sqrt(squared), nearest

    def sample(
        self, count: int, rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, "point 3"], Float[np.ndarray, "point 3"]]:
        """Area-uniform points and the normals there."""
        cumulative = np.cumsum(face_areas(self.verts, self.faces))
        strata = (np.arange(count) + rng.random(count)) / count * cumulative[-1]
        face = np.minimum(np.searchsorted(cumulative, strata, side="right"), len(self.faces) - 1)
        root, r2 = np.sqrt(rng.random(count)), rng.random(count)
        weights = np.stack([1 - root, root * (1 - r2), root * r2], axis=1)
        corners = self.verts[self.faces[face]]
        normals = face_normals(self.verts, self.faces[face])
        return np.einsum("pk,pkc->pc", weights, corners), normals

    def sample_seen(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "seen 3"]:
        """About `count` points that can be seen from outside."""
        points, normals = self.sample(2 * count, rng)
        seen = points[self._seen(points, normals, rng)]
        # Everything hides behind something (crossing sheets): then all of it counts.
        return seen[:: max(len(seen) // count, 1)] if len(seen) >= count // 10 else points[::2]

    def _seen(
        self,
        points: Float[np.ndarray, "point 3"],
        normals: Float[np.ndarray, "point 3"],
        rng: np.random.Generator,
    ) -> Bool[np.ndarray, " point"]:
        """Points from which enough rays leave, on either side of the sheet."""
        rays = ray_intersector(self.verts, self.faces)
        gap = 1e-4 * float(self.size.max())
        seen = np.zeros(len(points), dtype=bool)
        for side in (1.0, -1.0):
            facing = np.repeat(side * normals, N_VIEW_RAYS, axis=0)
            directions = rng.standard_normal((len(facing), 3))
            directions *= np.where((directions * facing).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
            origins = np.repeat(points, N_VIEW_RAYS, axis=0) + gap * facing
            free = ~rays.intersects_any(origins, directions)
            seen |= free.reshape(len(points), N_VIEW_RAYS).mean(axis=1) >= SEEN_SHARE
        return seen


@dataclass(frozen=True, kw_only=True)
class _Pair:
    """Both surfaces, with the points that are compared."""

    original: _Surface
    rescaled: _Surface
    points_original: Float[np.ndarray, "original_point 3"]
    points_rescaled: Float[np.ndarray, "rescaled_point 3"]

    @property
    def diagonal_m(self) -> float:
        return float(np.linalg.norm(self.rescaled.size))


@dataclass(frozen=True, kw_only=True)
class _Candidate:
    axis_rotation: Float[np.ndarray, "3 3"]
    size_error: float
    T: Float[np.ndarray, "4 4"]  # rescaled from original


def axis_rotations() -> tuple[Float[np.ndarray, "3 3"], ...]:
    """The 24 turns by right angles. First none (Y-up was turned to Z-up), then back to Y-up."""
    turns = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[np.arange(3), order] = signs
            if np.linalg.det(turn) > 0:
                turns.append(turn)
    expected = [np.eye(3), TURN_TO_Y_UP]
    others = [turn for turn in turns if not any(np.array_equal(turn, known) for known in expected)]
    return (*expected, *others)


def register(
    original_verts: Float[np.ndarray, "original_vert 3"],
    original_faces: Int[np.ndarray, "original_face 3"],
    rescaled_verts: Float[np.ndarray, "rescaled_vert 3"],
    rescaled_faces: Int[np.ndarray, "rescaled_face 3"],
    config: RegistrationConfig,
    *,
    source: object,
) -> Registration:
    """The similarity from the original (Z-up, any unit) to its rescaled copy (metres).

    Of several equally good turns the first of `axis_rotations` is taken. Deterministic.
    ObjectError where the copy has other proportions or lies farther off than `max_residual`.
    """
    rng = np.random.default_rng(0)
    original, rescaled = _Surface(original_verts, original_faces), _Surface(rescaled_verts, rescaled_faces)
    candidates = _box_candidates(original, rescaled, config, source)
    pair = _Pair(
        original=original,
        rescaled=rescaled,
        points_original=original.sample_seen(config.n_points, rng),
        points_rescaled=rescaled.sample(config.n_points, rng)[0],
    )
    coarse = np.array([_coarse_residual(pair, candidate.T) for candidate in candidates])
    # Refinement cannot make up for more than this; what is left are symmetric objects.
    within = coarse <= 1.5 * coarse.min() + 0.01
    results = [
        _result(pair, _refined(pair, candidate, config))
        for candidate, chosen in zip(candidates, within)
        if chosen
    ]
    means = np.array([_mean(result) for result in results])
    tie = means <= config.equally_good * means.min() + EXACT * pair.diagonal_m
    best = results[int(np.argmax(tie))]
    if best.residual > config.max_residual:
        raise ObjectError(
            source,
            f"does not match its rescaled copy: 5 % of the surface is {best.residual:.1%} of the diagonal "
            "off or more",
            expected=f"at most {config.max_residual:.1%} (`max_residual`)",
            action="Check that both files are the same object; draw it without textures otherwise.",
        )
    return best


def _box_candidates(
    original: _Surface, rescaled: _Surface, config: RegistrationConfig, source: object
) -> list[_Candidate]:
    """Turns that give the original the copy's proportions; centres and sizes already agree."""
    candidates, least = [], np.inf
    diagonal = np.linalg.norm(rescaled.size)
    for turn in axis_rotations():
        size = np.abs(turn) @ original.size
        factor = float(diagonal / np.linalg.norm(size))
        size_error = float(np.abs(rescaled.size - factor * size).max() / diagonal)
        least = min(least, size_error)
        if size_error <= config.max_size_error:
            T = np.eye(4)
            T[:3, :3] = factor * turn
            T[:3, 3] = rescaled.center - factor * turn @ original.center
            candidates.append(_Candidate(axis_rotation=turn, size_error=size_error, T=T))
    if not candidates:
        raise ObjectError(
            source,
            f"has other proportions than its rescaled copy (sides {least:.1%} of the diagonal off at best)",
            expected=f"one scale for all sides within {config.max_size_error:.1%} (`max_size_error`)",
            action="Check that both files are the same object; draw it without textures otherwise.",
        )
    return candidates


def _distances(
    pair: _Pair, T: Float[np.ndarray, "4 4"], stride: int
) -> tuple[Float[np.ndarray, " a"], Float[np.ndarray, " b"]]:
    """Metres of the rescaled frame: original's seen points to the copy, copy's points to the original."""
    scale = _scale(T)
    moved = pair.points_original[::stride] @ T[:3, :3].T + T[:3, 3]
    back = (pair.points_rescaled[::stride] - T[:3, 3]) @ T[:3, :3] / scale**2
    return pair.rescaled.nearest(moved)[0], scale * pair.original.nearest(back)[0]


def _scale(T: Float[np.ndarray, "4 4"]) -> float:
    return float(np.cbrt(np.linalg.det(T[:3, :3])))


def _coarse_residual(pair: _Pair, T: Float[np.ndarray, "4 4"]) -> float:
    """Mean distance of some of the points, both ways, relative to the diagonal."""
    forth, back = _distances(pair, T, 4)
    return float(0.5 * (forth.mean() + back.mean())) / pair.diagonal_m


def _refined(pair: _Pair, candidate: _Candidate, config: RegistrationConfig) -> _Candidate:
    """A few steps of similarity ICP with pairs from both sides; the farthest pairs are left out."""
    T = candidate.T
    for _ in range(config.icp_steps):
        scale = _scale(T)
        moved = pair.points_original @ T[:3, :3].T + T[:3, 3]
        forth, on_rescaled = pair.rescaled.nearest(moved)
        back, on_original = pair.original.nearest((pair.points_rescaled - T[:3, 3]) @ T[:3, :3] / scale**2)
        kept_forth = forth <= np.quantile(forth, ICP_KEPT_SHARE)
        kept_back = back <= np.quantile(back, ICP_KEPT_SHARE)
        T = _similarity(
            np.concatenate([pair.points_original[kept_forth], on_original[kept_back]]),
            np.concatenate([on_rescaled[kept_forth], pair.points_rescaled[kept_back]]),
        )
    return _Candidate(axis_rotation=candidate.axis_rotation, size_error=candidate.size_error, T=T)


def _similarity(
    points: Float[np.ndarray, "point 3"], targets: Float[np.ndarray, "point 3"]
) -> Float[np.ndarray, "4 4"]:
    """T with targets ~ T @ points, least squares over rotation, scale, shift (Umeyama, PAMI 1991, eq. 40-42).

    Scale: sqrt of the ratio of variances, which unlike eq. 42 treats both sides alike; pairs from
    nearest points would otherwise shrink the copy step by step.
    """
    mean_p, mean_t = points.mean(axis=0), targets.mean(axis=0)
    p, t = points - mean_p, targets - mean_t
    u, _, vt = np.linalg.svd(t.T @ p)
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    scale = np.sqrt((t**2).sum() / (p**2).sum())
    T = np.eye(4)
    T[:3, :3] = scale * rotation
    T[:3, 3] = mean_t - T[:3, :3] @ mean_p
    return T


def _result(pair: _Pair, candidate: _Candidate) -> Registration:
    forth, back = _distances(pair, candidate.T, 1)
    forth_p95, back_p95 = float(np.percentile(forth, 95)), float(np.percentile(back, 95))
    return Registration(
        T_rescaled_from_original=candidate.T,
        axis_rotation=candidate.axis_rotation,
        scale=_scale(candidate.T),
        size_error=candidate.size_error,
        original_to_rescaled_mean_m=float(forth.mean()),
        original_to_rescaled_p95_m=forth_p95,
        rescaled_to_original_mean_m=float(back.mean()),
        rescaled_to_original_p95_m=back_p95,
        residual=max(forth_p95, back_p95) / pair.diagonal_m,
    )


def _mean(result: Registration) -> float:
    return 0.5 * (result.original_to_rescaled_mean_m + result.rescaled_to_original_mean_m)
