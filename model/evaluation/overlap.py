"""Overlap and distance of voxel shapes and masks, as they are printed while training."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor

__all__ = ["intersection_over_union", "mean_shape", "voxel_chamfer"]


def intersection_over_union(
    predicted: Bool[Tensor, " batch *shape"], truth: Bool[Tensor, " batch *shape"]
) -> Float[Tensor, " batch"]:
    """IoU of each pair, 0..1; 1 where both are empty."""
    a, b = predicted.flatten(1), truth.flatten(1)
    union = (a | b).sum(1)
    overlap = (a & b).sum(1)
    return torch.where(union > 0, overlap / union.clamp(min=1), torch.ones_like(overlap, dtype=torch.float32))


def mean_shape(shapes: Bool[Tensor, "shape i j k"]) -> Bool[Tensor, "i j k"]:
    """The best single guess for all `shapes`: their mean, cut where its mean IoU with them is highest.

    At most 16 cuts are tried, evenly spread.
    """
    counts = shapes.sum(0)
    cuts = torch.linspace(1, len(shapes), min(len(shapes), 16)).round().int().tolist()
    guesses = [counts >= at_least for at_least in cuts]
    scores = [float(intersection_over_union(guess.expand_as(shapes), shapes).mean()) for guess in guesses]
    return guesses[max(range(len(scores)), key=scores.__getitem__)]


def voxel_chamfer(predicted: Bool[Tensor, "i j k"], truth: Bool[Tensor, "i j k"]) -> float:
    """Chamfer distance of occupied voxel centres, unit: the canonical cube's side.

    Mean of the two mean nearest distances, unsquared. When one of the two is empty, the cube's diagonal, which
    no two shapes in it are apart: nothing is never better than something.
    """
    a, b = ((occupied.nonzero().double() + 0.5) / occupied.shape[0] for occupied in (predicted, truth))
    if not len(a) or not len(b):
        return 0.0 if len(a) == len(b) else math.sqrt(3)
    to_b, to_a = KDTree(b.numpy()).query(a.numpy())[0], KDTree(a.numpy()).query(b.numpy())[0]
    return float(0.5 * (np.mean(to_b) + np.mean(to_a)))
