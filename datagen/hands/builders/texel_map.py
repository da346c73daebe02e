"""Where every texel of a UV layout lies on the hand."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

__all__ = ["TexelMap", "map_texels"]


@dataclass(frozen=True, kw_only=True)
class TexelMap:
    """Row 0 is the top of the image; face -1 where the layout is empty."""

    face: Int[np.ndarray, "row column"]
    barycentric: Float[np.ndarray, "row column 3"]

    @property
    def inside(self) -> Bool[np.ndarray, "row column"]:
        return self.face >= 0

    def sample(
        self, corner_values: Float[np.ndarray, "face 3 channel"]
    ) -> Float[np.ndarray, "row column channel"]:
        """Values given on face corners, interpolated to texels (0 outside)."""
        mixed = np.einsum("rck,rckd->rcd", self.barycentric, corner_values[np.maximum(self.face, 0)])
        return np.where(self.inside[..., None], mixed, 0.0)


def map_texels(corner_uv: Float[np.ndarray, "face 3 2"], size: int) -> TexelMap:
    """Rasterise the triangles of a UV layout at texel centres."""
    face = np.full((size, size), -1, dtype=np.int64)
    barycentric = np.zeros((size, size, 3))
    pixels = np.stack([corner_uv[..., 0], 1.0 - corner_uv[..., 1]], axis=-1) * size - 0.5
    for number, corners in enumerate(pixels):
        low = np.maximum(np.ceil(corners.min(axis=0)).astype(int), 0)
        high = np.minimum(np.floor(corners.max(axis=0)).astype(int), size - 1)
        matrix = np.vstack([corners.T, np.ones(3)])
        if (high < low).any() or abs(np.linalg.det(matrix)) < 1e-9:
            continue
        column, row = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
        weight = np.linalg.solve(matrix, np.stack([column, row, np.ones_like(row)]).reshape(3, -1)).T
        hit = (weight >= -1e-6).all(axis=1)
        face[row.reshape(-1)[hit], column.reshape(-1)[hit]] = number
        barycentric[row.reshape(-1)[hit], column.reshape(-1)[hit]] = weight[hit]
    return TexelMap(face=face, barycentric=barycentric)
