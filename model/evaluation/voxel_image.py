"""A shaded image of voxels, without a renderer."""

import numpy as np
import torch
from jaxtyping import Bool, UInt8

__all__ = ["voxel_image"]

_YAW_RAD, _PITCH_RAD = np.deg2rad(35.0), np.deg2rad(25.0)


def voxel_image(occupancy: Bool[torch.Tensor, "i j k"], size: int = 128) -> UInt8[np.ndarray, "size size 3"]:
    """Orthographic view from above the front right; near voxels bright, far ones dark, white ground."""
    filled = occupancy.cpu().numpy()
    image = np.full((size, size, 3), 255, dtype=np.uint8)
    points = (np.argwhere(filled) + 0.5) / filled.shape[0] - 0.5
    if not len(points):
        return image
    c, s = np.cos(_YAW_RAD), np.sin(_YAW_RAD)
    right, forward = c * points[:, 0] + s * points[:, 1], -s * points[:, 0] + c * points[:, 1]
    cp, sp = np.cos(_PITCH_RAD), np.sin(_PITCH_RAD)
    up, depth = cp * points[:, 2] + sp * forward, cp * forward - sp * points[:, 2]
    # The cube's diagonal fits, and a voxel covers the pixels up to its neighbour.
    scale = size / 1.75
    x, y = 0.5 * size + scale * right, 0.5 * size - scale * up
    half = int(np.ceil(0.5 * scale / filled.shape[0]))
    shade = np.clip(190 - 190 * (depth + 0.5), 30, 200).astype(np.uint8)
    for index in np.argsort(-depth):
        row, column = int(y[index]), int(x[index])
        image[max(row - half, 0) : row + half + 1, max(column - half, 0) : column + half + 1] = (
            shade[index],
            shade[index],
            min(255, int(shade[index]) + 40),
        )
    return image
