"""A PyTorch loader for images, amodal masks and poses, on top of `shards.reader`.

The training code has its own (`model/data/stream.py`: crops, augmentation, exact resume); this is the short version.

    python docs/examples/torch_loader.py data/tiny
"""

import sys

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from shards.reader import open_dataset

COLUMNS = ("rgb", "masks", "T_cam_from_world", "T_world_from_obj")


class ClipFrames(Dataset[dict[str, torch.Tensor]]):
    """Every frame of every clip of one split."""

    def __init__(self, url: str, split: str = "train") -> None:
        self.dataset = open_dataset(url)
        self.clips = [clip for clip in self.dataset.clips() if clip.split == split]
        self.places = [(clip, frame) for clip in self.clips for frame in range(clip.n_frames)]

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        clip, frame = self.places[index]
        frames = self.dataset.read_frames(clip.clip_id, COLUMNS)
        T_cam_from_obj = frames["T_cam_from_world"][frame] @ frames["T_world_from_obj"][frame]
        return {
            "rgb": torch.from_numpy(frames.rgb(frame)).permute(2, 0, 1) / 255,  # (3, height, width), sRGB
            "object_amodal": torch.from_numpy(frames.masks(frame).object_amodal),  # also where it is hidden
            "K": torch.from_numpy(np.array(clip.K)),  # pixels
            "T_cam_from_obj": torch.from_numpy(T_cam_from_obj),  # metres, OpenCV axes
        }


if __name__ == "__main__":
    for batch in DataLoader(ClipFrames(sys.argv[1]), batch_size=4, shuffle=True):
        print({name: tuple(tensor.shape) for name, tensor in batch.items()})
