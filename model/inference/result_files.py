"""The files of a reconstruction that are made to be looked at or used further; reconstruction.json is record.py's."""

from math import pi
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from model.data.batch import OCCUPANCY_VOXELS
from model.inference.reconstruction import Reconstruction
from model.surface.export import glb_bytes, voxel_mesh, voxels_ply
from model.surface.mesh import SurfaceMesh
from model.surface.rasteriser import Shading
from model.surface.turntable import TurntableConfig, turntable
from model.video.contact_sheet import Tile, contact_sheet, overlay, write_masks, write_png
from model.video.mp4 import write_mp4

__all__ = ["write_result"]

_TURN = TurntableConfig(
    frames=36,
    size_px=256,
    supersampling=2,
    fov_rad=40 * pi / 180,
    elevation_rad=20 * pi / 180,
    shading=Shading(two_sided=False, ambient=0.35, background_rgb=(0.93, 0.93, 0.93)),
)
_TURN_FPS = 18.0
_TILE_PX = 256
_VOXEL_GREY = 0.62  # stage 1 says nothing about colours


def write_result(result: Reconstruction, folder: Path) -> None:
    """object.glb (with stage 2), voxels.ply, masks/NNNNNN.png, turntable.mp4, contact_sheet.png.

    Equal reconstructions give equal bytes. The turntable shows the voxels where there is no surface.
    """
    voxels = result.voxels
    greys = np.full((len(voxels), 3), _VOXEL_GREY, np.float32)
    (folder / "voxels.ply").write_bytes(voxels_ply(voxels, OCCUPANCY_VOXELS, greys))
    blocks = voxel_mesh(voxels, OCCUPANCY_VOXELS, greys)
    surface = None if result.surface is None else result.surface.mesh
    if surface is not None:
        (folder / "object.glb").write_bytes(glb_bytes(surface, np.eye(4)))
    write_masks(folder / "masks", result.frames.frames, list(result.masks), result.windows)
    turn = turntable(blocks if surface is None else surface, _TURN)
    write_mp4(turn, folder / "turntable.mp4", _TURN_FPS)
    write_png(folder / "contact_sheet.png", _sheet(result, blocks, None if surface is None else turn))


def _sheet(
    result: Reconstruction, blocks: SurfaceMesh, turn: UInt8[np.ndarray, "frame size size 3"] | None
) -> UInt8[np.ndarray, "height width 3"]:
    """A row per frame: image, crop, mask; then voxels and surface from three sides."""
    rows = []
    for frame, crop, image, mask in zip(result.frames.frames, result.crops, result.images, result.masks):
        plain = np.round(255 * image.transpose(1, 2, 0)).astype(np.uint8)
        rows.append(
            [
                Tile(image=frame.image, label=frame.name),
                Tile(image=plain, label=f"crop: {crop.origin}"),
                Tile(image=overlay(image, mask), label=f"amodal mask: {(mask > 0.5).mean():.0%} of the crop"),
            ]
        )
    three = TurntableConfig(**(vars(_TURN) | {"frames": 3}))
    rows.append(_three_sides(turntable(blocks, three), f"stage 1: {len(result.voxels)} voxels"))
    if turn is not None and result.surface is not None:
        label = f"stage 2: {result.surface.report.faces} faces"
        rows.append(_three_sides(turn[:: _TURN.frames // 3], label))
    return contact_sheet(rows, _TILE_PX)


def _three_sides(images: UInt8[np.ndarray, "three size size 3"], label: str) -> list[Tile]:
    return [
        Tile(image=image, label=label if i == 0 else f"turned by {120 * i} degrees")
        for i, image in enumerate(images)
    ]
