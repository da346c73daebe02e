"""Vertex colours baked into an image, so that everything downstream knows only textures."""

import io

import numpy as np
from jaxtyping import Float
from PIL import Image

from shards.color import srgb_from_linear

__all__ = ["baked_vertex_colors"]

MAX_SIDE_PX = 2048


def baked_vertex_colors(
    corner_colors: Float[np.ndarray, "face 3 rgb"],
) -> tuple[bytes, Float[np.ndarray, "face 3 2"]]:
    """A PNG atlas with one square tile per face, and the corner UVs into it.

    Colours (linear 0..1) are interpolated over each triangle as a renderer would. A tile holds
    its triangle in the lower left half and mirrored colours beyond, so filtering stays clean.
    """
    n_faces = len(corner_colors)
    tiles_per_side = int(np.ceil(np.sqrt(n_faces)))
    tile_px = max(min(MAX_SIDE_PX // tiles_per_side, 16), 3)
    side_px = tile_px * tiles_per_side
    # Corners sit on texel centres one texel inside the tile.
    steps = np.arange(tile_px, dtype=np.float64) / (tile_px - 1)
    along_b, along_c = np.meshgrid(steps, steps)
    beyond = along_b + along_c > 1
    beta = np.where(beyond, 1 - along_c, along_b)
    gamma = np.where(beyond, 1 - along_b, along_c)
    weights = np.stack([1 - beta - gamma, beta, gamma], axis=-1)
    tiles = np.einsum("ijk,fkc->fijc", np.clip(weights, 0, 1), corner_colors)
    atlas = np.zeros((tiles_per_side**2, tile_px, tile_px, 3))
    atlas[:n_faces] = tiles
    grid = atlas.reshape(tiles_per_side, tiles_per_side, tile_px, tile_px, 3)
    image = grid.transpose(0, 2, 1, 3, 4).reshape(side_px, side_px, 3)
    pixels = np.round(srgb_from_linear(image) * 255).astype(np.uint8)
    row, column = np.divmod(np.arange(n_faces), tiles_per_side)
    left = column * tile_px + 0.5
    top = row * tile_px + 0.5
    span = tile_px - 1
    x = np.stack([left, left + span, left], axis=1)
    y = np.stack([top, top, top + span], axis=1)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    return buffer.getvalue(), np.stack([x / side_px, 1.0 - y / side_px], axis=-1)
