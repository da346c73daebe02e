"""reconstruct: images of a hand that holds an object to amodal masks, voxels and a closed coloured mesh."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, UInt8

from model.errors import ModelError
from model.inference.crops import CloserCrop, FrameCrop, closer_crop, first_crops, hand_regions
from model.inference.networks import Networks, StageTwoNetworks
from model.inference.stage_clock import StageClock
from model.inference.stages import run_stage_one, run_stage_two
from model.surface.watertight_mesh import ExtractedSurface, SurfaceExtractionConfig, extracted_surface
from model.video.frames import VideoFrame, VideoFrames
from model.video.square_crop import SquareWindow

__all__ = ["STANDARD", "Reconstruction", "ReconstructionSettings", "frames_of_images", "reconstruct"]


@dataclass(frozen=True, kw_only=True)
class ReconstructionSettings:
    """What the networks do not decide."""

    seed: int  # of the noise that is denoised; 0 or more
    closer_crop: CloserCrop | None  # None: one pass, on the first squares
    min_component_share: float  # as in SurfaceExtractionConfig, all three
    max_faces: int
    max_simplification_move: float


STANDARD = ReconstructionSettings(
    seed=0,
    closer_crop=CloserCrop(max_side_share=0.9, min_side_share=0.1),
    min_component_share=0.01,
    max_faces=200_000,
    max_simplification_move=0.002,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Reconstruction:
    """What was found in some frames. Shapes are in the canonical frame: Z up, cube [-0.5, 0.5]^3."""

    frames: VideoFrames
    crops: tuple[FrameCrop, ...]  # of the last pass
    windows: tuple[SquareWindow, ...]
    images: Float32[np.ndarray, "view 3 size size"]  # crops as stage 1 saw them, sRGB 0..1
    masks: Float32[np.ndarray, "view size size"]  # amodal object mask on the crops, probability
    occupancy: Bool[np.ndarray, "64 64 64"]  # [i, j, k] along x, y, z
    surface: ExtractedSurface | None  # None without stage 2
    seed: int
    notes: tuple[str, ...]  # what the user should know

    @property
    def voxels(self) -> Int[np.ndarray, "voxel 3"]:
        """(i, j, k) of the occupied voxels."""
        return np.argwhere(self.occupancy)


def frames_of_images(images: Sequence[UInt8[np.ndarray, "_ _ 3"]]) -> VideoFrames:
    """Upright sRGB images in memory, as `reconstruct` takes them. ModelError when there is none."""
    frames = tuple(
        VideoFrame(
            image=image,
            index=i,
            time_s=float("nan"),
            name=f"image {i}",
            source_size=(image.shape[1], image.shape[0]),
            changes=(),
        )
        for i, image in enumerate(images)
    )
    return VideoFrames(source="images", kind="images", frames=frames, n_source_frames=len(frames), notes=())


def reconstruct(
    frames: VideoFrames,
    networks: Networks,
    settings: ReconstructionSettings = STANDARD,
    *,
    boxes_px: Sequence[Float[np.ndarray, "4"]] | None = None,
    clock: StageClock | None = None,
) -> Reconstruction:
    """Masks and voxels (stage 1), then the surface (stage 2), from all the frames.

    Of many frames take informative ones first: `frames.select(choose_frames(frames, 6).positions)`.

    The same seed gives the same bits on one machine's CPU; on CUDA sparse convolutions add in any order. `boxes_px`:
    x0, y0, x1, y1 around hand and object in each image, for the first crop. `clock` learns how long each stage takes.
    ModelError when there is no object in the frames, or no surface.
    """
    clock = clock or StageClock()
    crops = first_crops(frames, boxes_px)
    if settings.closer_crop is not None:
        with clock.stage("find hand and object"):
            crops = _closer_crops(frames, crops, networks, settings.seed, settings.closer_crop)
    with clock.stage("stage 1: masks and voxels"):
        one = run_stage_one(frames, crops, networks, settings.seed)
    if not one.occupancy.any():
        raise ModelError(
            frames.source,
            f"no object found in {len(frames)} frame{'s' if len(frames) > 1 else ''}: stage 1 fills no voxel",
            expected="a hand that holds an object",
            action="Choose other frames (--frames), or give a box around hand and object (--box).",
        )
    surface, two = None, networks.stage_two
    if two is not None:
        with clock.stage("stage 2: structured latents"):
            fields = run_stage_two(frames, crops, one.occupancy, two, networks.device, settings.seed)
        with clock.stage("mesh"):
            surface = extracted_surface(fields, _extraction_config(settings, two))
    return Reconstruction(
        frames=frames,
        crops=tuple(crops),
        windows=one.windows,
        images=one.images,
        masks=one.masks,
        occupancy=one.occupancy,
        surface=surface,
        seed=settings.seed,
        notes=_notes(frames, networks, one.masks, has_surface=surface is not None),
    )


def _closer_crops(
    frames: VideoFrames, crops: Sequence[FrameCrop], networks: Networks, seed: int, limits: CloserCrop
) -> list[FrameCrop]:
    """Squares around hand and object, found by a first pass of stage 1 on the squares given."""
    stage = networks.stage_one
    first = run_stage_one(frames, crops, networks, seed)
    hands = hand_regions(stage.hand, torch.from_numpy(first.images).to(networks.device))
    return [
        closer_crop(frame, crop, (mask > 0.5, hand), stage.crop_margin, limits)
        for frame, crop, mask, hand in zip(frames.frames, crops, first.masks, hands)
    ]


def _extraction_config(settings: ReconstructionSettings, stage: StageTwoNetworks) -> SurfaceExtractionConfig:
    """Surfaces are taken as they were when the decoder was measured."""
    return SurfaceExtractionConfig(
        extraction=stage.task.evaluation.extraction,
        min_component_share=settings.min_component_share,
        max_faces=settings.max_faces,
        max_simplification_move=settings.max_simplification_move,
    )


def _notes(
    frames: VideoFrames,
    networks: Networks,
    masks: Float32[np.ndarray, "view size size"],
    *,
    has_surface: bool,
) -> tuple[str, ...]:
    """About the input, the weights and the result."""
    partly = [c for c in networks.checkpoints if c.step < c.steps]
    notes = [*frames.notes, *(f"{c.part} is trained for {c.step} of {c.steps} steps" for c in partly)]
    empty = [frame.name for frame, mask in zip(frames.frames, masks) if not (mask > 0.5).any()]
    if empty:
        notes.append(f"no object seen in {', '.join(empty)}: empty mask")
    if not has_surface:
        notes.append("stage 1 only: no surface and no colours, the turntable shows the voxels")
    return tuple(notes)
