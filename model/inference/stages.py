"""One run of each stage on some frames: crops in, arrays out. The noise is a function of seed and stage."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from model.inference.crops import FrameCrop, cropped
from model.inference.networks import Networks, StageOneNetworks, StageTwoNetworks
from model.surface.fields import SurfaceFields
from model.video.frames import VideoFrames
from model.video.square_crop import SquareWindow

__all__ = ["StageOneResult", "run_stage_one", "run_stage_two"]


class _Stage(IntEnum):
    """Second word of the seed, so that no two stages draw the same noise."""

    ONE = 1
    TWO = 2


@dataclass(frozen=True, kw_only=True, eq=False)
class StageOneResult:
    """What stage 1 sees in the crops."""

    images: Float32[np.ndarray, "view 3 size size"]  # crops, sRGB 0..1
    windows: tuple[SquareWindow, ...]  # where they lie
    masks: Float32[np.ndarray, "view size size"]  # amodal object mask, probability
    occupancy: Bool[np.ndarray, "64 64 64"]  # [i, j, k] along x, y, z of the canonical frame


def run_stage_one(
    frames: VideoFrames, crops: Sequence[FrameCrop], networks: Networks, seed: int
) -> StageOneResult:
    """Masks and shape, denoised together from the noise of `seed`."""
    stage: StageOneNetworks = networks.stage_one
    images, windows = cropped(frames, crops, stage.image_size)
    found = stage.task.predict(_as_batch(images, networks.device), _generator(seed, _Stage.ONE))
    # Clean masks are -1 or +1; between them they are the posterior mean.
    probabilities = (0.5 + 0.5 * found.masks[0].float()).clamp(0, 1).cpu().numpy()
    size = (stage.image_size, stage.image_size)
    return StageOneResult(
        images=images,
        windows=windows,
        masks=np.stack([cv2.resize(mask, size, interpolation=cv2.INTER_LINEAR) for mask in probabilities]),
        occupancy=found.occupancy[0].cpu().numpy(),
    )


def run_stage_two(
    frames: VideoFrames,
    crops: Sequence[FrameCrop],
    occupancy: Bool[np.ndarray, "64 64 64"],
    stage: StageTwoNetworks,
    device: torch.device,
    seed: int,
) -> SurfaceFields:
    """What the surface decoder says about structured latents that are denoised on the voxels. ModelError: no voxel."""
    images, _ = cropped(frames, crops, stage.image_size)
    voxels = torch.from_numpy(occupancy)[None].to(device)
    return stage.task.predict(_as_batch(images, device), voxels, _generator(seed, _Stage.TWO)).fields(0)


def _as_batch(images: Float32[np.ndarray, "view 3 size size"], device: torch.device) -> Tensor:
    return torch.from_numpy(images)[None].to(device)


def _generator(seed: int, stage: _Stage) -> torch.Generator:
    """On the CPU, so that any device starts from the same noise."""
    word = np.random.SeedSequence([seed, int(stage)]).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(word >> np.uint64(1)))
