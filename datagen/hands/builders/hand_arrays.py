"""The arrays of a hand while it is being built.

Rest frame, metres: fingers to -x, thumb to +z, back of the hand to +y.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import nnls

from datagen.hands.model import PARENTS
from shards.joints import DIGIT_JOINTS, DIGITS

__all__ = [
    "HandArrays",
    "descendants",
    "digit_chain",
    "fit_regressor_row",
    "neighbour_mean",
    "read_base_hand",
    "rotate_about",
    "smoothstep",
]


@dataclass(frozen=True, kw_only=True, eq=False)
class HandArrays:
    """Everything the stages hand on; see `HandModel` for the meaning of the fields."""

    v_template: Float[np.ndarray, "vert 3"]
    shapedirs: Float[np.ndarray, "vert 3 beta"]
    posedirs: Float[np.ndarray, "vert 3 135"]
    J_regressor: Float[np.ndarray, "16 vert"]
    weights: Float[np.ndarray, "vert 16"]
    faces: Int[np.ndarray, "face 3"]
    hands_mean: Float[np.ndarray, "45"]
    tip_ids: Int[np.ndarray, "5"]
    corner_uv: Float[np.ndarray, "face 3 2"]
    wrist_loop: Int[np.ndarray, " loop"]

    @property
    def joints(self) -> Float[np.ndarray, "16 3"]:
        """Rest joints of the mean shape."""
        return self.J_regressor @ self.v_template

    @property
    def shape_samples(self) -> Float[np.ndarray, "sample vert 3"]:
        """The mean hand, then the hand at +1 of every shape coefficient: a basis of all shapes."""
        offsets = np.concatenate([np.zeros_like(self.v_template)[None], np.moveaxis(self.shapedirs, 2, 0)])
        return self.v_template + offsets


def read_base_hand(path: Path) -> HandArrays:
    """The sampled base hand (open at the wrist, no corrective shapes, zero mean pose)."""
    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files}
    faces = arrays["f"].astype(np.int64)
    n_verts = len(arrays["v_template"])
    weights = arrays["weights"].astype(np.float64)
    return HandArrays(
        v_template=arrays["v_template"].astype(np.float64),
        shapedirs=arrays["shapedirs"].astype(np.float64),
        posedirs=np.zeros((n_verts, 3, 135)),
        J_regressor=arrays["J_regressor"].astype(np.float64),
        weights=weights / weights.sum(axis=1, keepdims=True),
        faces=faces,
        hands_mean=np.zeros(45),
        tip_ids=arrays["tip_ids"].astype(np.int64),
        corner_uv=arrays["uv"].astype(np.float64)[arrays["f_uv"]],
        wrist_loop=_border_loop(faces),
    )


def _border_loop(faces: Int[np.ndarray, "face 3"]) -> Int[np.ndarray, " loop"]:
    """Vertices of the one open border, following the half-edges of its faces."""
    half_edges = {(int(a), int(b)) for a, b in faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)}
    after = {a: b for a, b in half_edges if (b, a) not in half_edges}
    loop = [min(after)]
    while (following := after[loop[-1]]) != loop[0]:
        loop.append(following)
    if len(loop) != len(after):
        raise ValueError(
            f"base hand: expected one open border, found {len(after)} edges but a loop of {len(loop)}"
        )
    return np.array(loop)


def digit_chain(hand: HandArrays, digit: str) -> Float[np.ndarray, "4 3"]:
    """The three pivots of a digit, then its tip."""
    tip = hand.v_template[hand.tip_ids[DIGITS.index(digit)]]
    return np.vstack([hand.joints[list(DIGIT_JOINTS[digit])], tip])


def descendants(joint: int) -> list[int]:
    """The joint and everything that hangs on it."""
    found = [joint]
    for child in range(joint + 1, 16):
        if PARENTS[child] in found:
            found.append(child)
    return found


def fit_regressor_row(
    samples: Float[np.ndarray, "sample vert 3"], targets: Float[np.ndarray, "sample 3"], n_nearest: int = 150
) -> Float[np.ndarray, " vert"]:
    """Non-negative weights of nearby vertices, summing to one, that give `targets` for all samples."""
    near = np.argsort(np.linalg.norm(samples[0] - targets[0], axis=1), kind="stable")[:n_nearest]
    # Shapes differ from the mean by a few millimetres: fit the mean and the differences, in millimetres.
    basis = (
        np.concatenate([samples[:1], samples[1:] - samples[:1]])[:, near]
        .transpose(0, 2, 1)
        .reshape(-1, n_nearest)
    )
    wanted = np.concatenate([targets[:1], targets[1:] - targets[:1]]).reshape(-1)
    heavy = 100.0
    solution, _ = nnls(
        np.vstack([1e3 * basis, heavy * np.ones((1, n_nearest))]), np.concatenate([1e3 * wanted, [heavy]])
    )
    row = np.zeros(samples.shape[1])
    row[near] = solution / solution.sum()
    return row


def neighbour_mean(faces: Int[np.ndarray, "face 3"], n_verts: int) -> Float[np.ndarray, "vert vert"]:
    """Matrix that replaces each vertex by the mean of its neighbours."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = np.vstack([edges, edges[:, ::-1]])
    adjacency = np.zeros((n_verts, n_verts))
    adjacency[edges[:, 0], edges[:, 1]] = 1.0
    return adjacency / adjacency.sum(axis=1, keepdims=True)


def rotate_about(
    axis: Float[np.ndarray, "3"], angle_rad: Float[np.ndarray, " n"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Each point turned by its own angle about one unit axis through the origin (Rodrigues)."""
    cos, sin = np.cos(angle_rad)[:, None], np.sin(angle_rad)[:, None]
    return points * cos + np.cross(axis, points) * sin + np.outer(points @ axis, axis) * (1.0 - cos)


def smoothstep(x: Float[np.ndarray, "*n"], low: float, high: float) -> Float[np.ndarray, "*n"]:
    """0 below `low`, 1 above `high`, twice differentiable in between."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t**3 * (t * (6.0 * t - 15.0) + 10.0)
