"""What stage 1 sees and predicts, side by side."""

import numpy as np
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional

from model.data.batch import Batch
from model.evaluation.voxel_image import voxel_image

__all__ = ["prediction_rows"]

TILE = 128
SAMPLES, VIEWS = 3, 3


def prediction_rows(
    batch: Batch, masks: Float[Tensor, "batch view m m"], occupancy: Bool[Tensor, "batch 64 64 64"]
) -> UInt8[np.ndarray, "height width 3"]:
    """A row per sample: for each view input, visible, true and predicted amodal mask; then true and predicted voxels.

    `masks` and `occupancy` are the predicted ones, as in `Prediction`.
    """
    rows = []
    for s in range(min(SAMPLES, len(batch.ids))):
        tiles = []
        for v in range(min(VIEWS, batch.images.shape[1])):
            image = _tile(batch.images[s, v].float())
            tiles += [
                image,
                _grey(batch.object_visible[s, v].float()),
                _grey(batch.object_amodal[s, v].float()),
            ]
            tiles.append(_grey((masks[s, v].float() + 1.0) / 2.0))
        tiles += [voxel_image(batch.occupancy[s], TILE), voxel_image(occupancy[s], TILE)]
        rows.append(np.concatenate(tiles, axis=1))
    return np.concatenate(rows, axis=0)


def _tile(image: Float[Tensor, "3 size size"]) -> UInt8[np.ndarray, "tile tile 3"]:
    small = functional.interpolate(image[None], size=(TILE, TILE), mode="bilinear", align_corners=False)[0]
    return (255.0 * small.clamp(0.0, 1.0)).round().byte().permute(1, 2, 0).cpu().numpy()


def _grey(mask: Float[Tensor, "size size"]) -> UInt8[np.ndarray, "tile tile 3"]:
    return _tile(mask[None].expand(3, -1, -1))
