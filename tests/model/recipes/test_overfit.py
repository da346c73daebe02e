"""One motion can be learned by heart: what stage 1 says about the views it was trained on is right."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from accelerate import Accelerator

from model.data.stream import ShardStream
from model.recipes.config import parse_config, read_settings
from model.recipes.stage_one_config import StageOneTrainingConfig
from model.recipes.train_component import train_component
from shards.geometry import intrinsics_from_fov
from shards.schema import ClipRow, FrameRow
from shards.storage.images import MASK_BITS, decode_masks, encode_masks, encode_rgb_png, mask_box_px
from shards.writer import begin_dataset, commit_shard, stage_motion
from tests.model.data.balls import uid_of_split
from tests.model.data.voxel_scene import lopsided_occupancy, render_mask
from tests.model.stages import stage_one
from tests.shards.synthetic import (
    PROVENANCE,
    dataset_record,
    synthetic_clip,
    synthetic_object,
)

CAMERAS, FRAMES, SIZE_PX = 3, 2, 256
TRAINED_VIEWS = (CAMERAS - 1) * FRAMES  # the last camera is held out
VAE_STEPS, STEPS = 200, 700
COLORS = {"object": (200, 90, 40), "hand": (230, 190, 160), "arm": (90, 120, 200)}


def write_motion(root: Path) -> Path:
    """One motion: the lopsided object of many voxels behind a ball for a hand and a ball for an arm."""
    T_objmesh_from_canonical = synthetic_object(0).T_objmesh_from_canonical
    occupancy = lopsided_occupancy()
    object_row = replace(
        synthetic_object(0),
        object_uid=uid_of_split("train", 0),
        occupancy_64=np.argwhere(occupancy).astype(np.uint8),
    )
    K = intrinsics_from_fov(0.7, (SIZE_PX, SIZE_PX))

    def with_object(frame: FrameRow) -> FrameRow:
        T = frame.T_cam_from_world @ frame.T_world_from_obj @ T_objmesh_from_canonical
        return _with_object(frame, render_mask(occupancy, T, K, (SIZE_PX, SIZE_PX)))

    clips: list[ClipRow] = []
    frames: list[FrameRow] = []
    for camera in range(CAMERAS):
        clip, clip_frames = synthetic_clip(object_row, 0, camera, FRAMES, SIZE_PX)
        clips.append(clip)
        frames.extend(with_object(frame) for frame in clip_frames)
    begin_dataset(root, dataset_record())
    stage_motion(
        root, 0, 0, object_row=object_row, clips=clips, frames=frames, timings_s={}, provenance=PROVENANCE
    )
    commit_shard(root, 0, motion_indices=[0], provenance=PROVENANCE)
    return root


def _with_object(frame: FrameRow, amodal: np.ndarray) -> FrameRow:
    """The frame with another object in the place of its ball."""
    balls = decode_masks(frame.masks)
    masks = {
        "hand_visible": balls.hand_visible,
        "hand_amodal": balls.hand_amodal,
        "arm_visible": balls.arm_visible,
        "arm_amodal": balls.arm_amodal,
        "object_visible": amodal & ~balls.hand_amodal & ~balls.arm_amodal,
        "object_amodal": amodal,
    }
    bits = np.sum([np.uint8(MASK_BITS[name]) * mask for name, mask in masks.items()], axis=0, dtype=np.uint8)
    rgb = np.full((*amodal.shape, 3), 60, np.uint8)
    for name, color in COLORS.items():
        rgb[masks[f"{name}_visible"]] = color
    return replace(
        frame,
        rgb=encode_rgb_png(rgb),
        masks=encode_masks(bits),
        object_box_amodal_px=np.array(mask_box_px(amodal)),
        object_box_visible_px=np.array(mask_box_px(masks["object_visible"])),
        object_pixels_amodal=int(amodal.sum()),
        object_pixels_visible=int(masks["object_visible"].sum()),
        object_visible_fraction=float(masks["object_visible"].sum() / amodal.sum()),
    )


def memorising_config(dataset: Path) -> StageOneTrainingConfig:
    """configs/model/tiny.yaml on fixed crops, all of them in every sample, with masks of a cell per pixel."""
    settings = read_settings("tiny").data
    settings["data"] |= {
        "datasets": [str(dataset)],
        "workers": 0,
        "held_out_cameras": 1 / CAMERAS,
        "augmentation": {"margin": [1.1, 1.1], "shift": 0.0, "roll_deg": [0.0, 0.0], "flip_probability": 0.0},
    }
    settings["validation"] |= {"views": FRAMES, "batch_size": 1, "samples_per_motion": 1, "batches": 1}
    settings["encoders"]["cached_views"] = CAMERAS * FRAMES
    flow = settings["stage_one"]
    flow["network"]["masks"] |= {"patch": 8}  # 16 tokens x 8 = the 128 px of the crops
    flow["drop_condition"] = 0.0  # for guidance, which is off
    sections = {
        "vae": (settings["vae"], {"batch_size": 1}, VAE_STEPS),
        "stage_one": (flow, {"batch_size": 2, "views": [TRAINED_VIEWS] * 2}, STEPS),
    }
    for section, sizes, steps in sections.values():
        section["recipe"] |= sizes
        section["recipe"]["trainer"] |= {"steps": steps, "checkpoint_every": steps, "validate_every": steps}
    # At the rate of tiny.yaml a limb of the object can be lost for good: Dice has no gradient where it is sure.
    settings["vae"]["recipe"]["optimizer"]["learning_rate"] = 1e-3
    return stage_one(parse_config(yaml.safe_dump(settings), where="overfit"))


@pytest.mark.slow
def test_one_motion_is_learned_by_heart(tmp_path):
    config = memorising_config(write_motion(tmp_path / "data"))
    accelerator = Accelerator(cpu=True)
    for component in config.components():
        train_component(component, config, tmp_path / "run", accelerator=accelerator, report=lambda _: None)
    task = config.flow.load(tmp_path / "run", torch.device("cpu"))
    trained = replace(
        config.stage_one.recipe.stream(config.data, surface=False),
        views=(TRAINED_VIEWS, TRAINED_VIEWS),
        batch_size=1,
        endless=False,
        samples_per_motion=4,  # the same views, other noise
    )
    metrics = task.measure(ShardStream(trained)).evaluation().metrics
    assert metrics["visible_iou"] < 0.9  # else there would be nothing to complete
    assert metrics["voxel_iou"] > 0.95
    assert metrics["mask_iou"] > 0.98
