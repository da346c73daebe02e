"""Images that show a reconstruction at a glance, and the mask files."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8
from PIL import Image, ImageDraw, ImageFont

from model.video.frames import VideoFrame
from model.video.square_crop import SquareWindow, mask_on_source

__all__ = ["Tile", "contact_sheet", "overlay", "write_masks", "write_png"]

_TINT = np.array([255, 120, 0], np.float32)
_LABEL_PX, _GAP_PX = 18, 4
_PAPER, _INK = (24, 24, 24), (235, 235, 235)


@dataclass(frozen=True, kw_only=True, eq=False)
class Tile:
    """One image of a sheet with a line of text below it."""

    image: UInt8[np.ndarray, "height width 3"]
    label: str


def contact_sheet(
    rows: Sequence[Sequence[Tile]], tile_px: int
) -> UInt8[np.ndarray, "sheet_height sheet_width 3"]:
    """Rows of tiles, each fitted into a square of `tile_px`; a row per frame, then rows of renders."""
    columns = max(len(row) for row in rows)
    step_x, step_y = tile_px + _GAP_PX, tile_px + _LABEL_PX + _GAP_PX
    sheet = Image.new("RGB", (columns * step_x + _GAP_PX, len(rows) * step_y + _GAP_PX), _PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(_LABEL_PX * 2 // 3)
    for j, row in enumerate(rows):
        for i, tile in enumerate(row):
            x, y = _GAP_PX + i * step_x, _GAP_PX + j * step_y
            small = _fitted(tile.image, tile_px)
            left, top = (tile_px - small.shape[1]) // 2, (tile_px - small.shape[0]) // 2
            sheet.paste(Image.fromarray(small), (x + left, y + top))
            draw.text((x + 1, y + tile_px + 1), _shortened(tile.label, font, tile_px), _INK, font)
    return np.array(sheet)


def overlay(
    crop: Float[np.ndarray, "3 size size"],
    mask: Float[np.ndarray, "size size"] | Bool[np.ndarray, "size size"],
) -> UInt8[np.ndarray, "size size 3"]:
    """The crop (0..1) with the mask (probability) tinted and outlined."""
    inside = np.asarray(mask) > 0.5
    image = 255.0 * np.clip(crop, 0.0, 1.0).transpose(1, 2, 0)
    image = np.where(inside[..., None], 0.55 * image + 0.45 * _TINT, image)
    edge = inside & ~cv2.erode(inside.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    image[edge] = _TINT
    return image.round().astype(np.uint8)


def write_masks(
    folder: Path,
    frames: Sequence[VideoFrame],
    masks: Sequence[Float[np.ndarray, "size size"]],
    windows: Sequence[SquareWindow],
) -> list[Path]:
    """One PNG (0 or 255) per frame at its source size, upright, named after its index in the source."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for frame, mask, window in zip(frames, masks, windows, strict=True):
        paths.append(folder / f"{frame.index:06d}.png")
        write_png(paths[-1], mask_on_source(mask, window, frame) * np.uint8(255))
    return paths


def write_png(path: Path, pixels: Shaped[np.ndarray, "height width *channels"]) -> None:
    """8-bit grey or RGB."""
    Image.fromarray(pixels).save(path)


def _fitted(
    image: UInt8[np.ndarray, "height width 3"], side_px: int
) -> UInt8[np.ndarray, "new_height new_width 3"]:
    scale = side_px / max(image.shape[:2])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return image if scale == 1 else cv2.resize(image, size, interpolation=method)


def _shortened(text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, width_px: int) -> str:
    if font.getlength(text) <= width_px:
        return text
    while text and font.getlength(text + "...") > width_px:
        text = text[:-1]
    return text + "..."
