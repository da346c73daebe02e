"""TrainingSample (one motion, several views) and Batch: what the network is fed.

Frames: *canonical* is the object's unit cube (shards/README.md), *cam* the OpenCV camera of a view after
its crop, roll and mirror. `K` belongs to the crop: pixels, image corner at (0, 0).
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int

__all__ = ["OCCUPANCY_VOXELS", "Batch", "TrainingSample", "stack_samples"]

OCCUPANCY_VOXELS = 64


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingSample:
    """Some views of one motion, cropped, with the targets of all of them."""

    motion_id: str
    object_uid: str
    split: str
    clip_ids: tuple[str, ...]  # one per view
    frame_indices: Int[np.ndarray, "view"]
    images: Float32[np.ndarray, "view 3 size size"]  # sRGB, 0..1; 0 outside the rendered image
    object_amodal: Bool[np.ndarray, "view size size"]
    object_visible: Bool[np.ndarray, "view size size"]
    hand_visible: Bool[np.ndarray, "view size size"]  # hand, forearm and sleeve
    K: Float32[np.ndarray, "view 3 3"]
    T_cam_from_canonical: Float32[np.ndarray, "view 4 4"]  # similarity: canonical cube to camera metres
    occupancy: Bool[np.ndarray, "64 64 64"]  # [i, j, k] along x, y, z of the canonical frame
    joints_px: Float32[np.ndarray, "view 21 2"]  # NaN behind the camera
    is_right: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class Batch:
    """Samples stacked along a leading axis; all of them have the same number of views."""

    images: Float[torch.Tensor, "batch view 3 size size"]  # sRGB, 0..1
    object_amodal: Bool[torch.Tensor, "batch view size size"]
    object_visible: Bool[torch.Tensor, "batch view size size"]
    hand_visible: Bool[torch.Tensor, "batch view size size"]
    K: Float[torch.Tensor, "batch view 3 3"]
    T_cam_from_canonical: Float[torch.Tensor, "batch view 4 4"]
    occupancy: Bool[torch.Tensor, "batch 64 64 64"]
    joints_px: Float[torch.Tensor, "batch view 21 2"]  # NaN behind the camera
    is_right: Bool[torch.Tensor, "batch"]
    ids: tuple[str, ...]  # "motion_id:epoch:position", one per sample

    def to(self, device: torch.device | str, dtype: torch.dtype) -> "Batch":
        """On `device`, with images as `dtype`.

        Geometry keeps float32: bfloat16 holds a pixel position only to about one pixel in 256.
        """
        moved = {
            f.name: getattr(self, f.name).to(device, non_blocking=True)
            for f in fields(self)
            if f.name != "ids"
        }
        moved["images"] = moved["images"].to(dtype)
        return replace(self, **moved)


def stack_samples(samples: Sequence[TrainingSample], ids: Sequence[str], *, shared: bool = False) -> Batch:
    """The batch of `samples`, in order; `ids` name them.

    `shared` puts the tensors straight into shared memory: in a loader worker this saves the copy that
    sending them would make.
    """

    def stacked(name: str) -> torch.Tensor:
        arrays = [np.asarray(getattr(sample, name)) for sample in samples]
        out = _empty((len(arrays), *arrays[0].shape), arrays[0].dtype, shared=shared)
        view = out.numpy()
        for index, array in enumerate(arrays):
            view[index] = array  # also undoes the negative strides of a mirrored sample
        return out

    return Batch(**{f.name: stacked(f.name) for f in fields(Batch) if f.name != "ids"}, ids=tuple(ids))


def _empty(shape: tuple[int, ...], dtype: np.dtype, *, shared: bool) -> torch.Tensor:
    torch_dtype = {np.dtype(np.float32): torch.float32, np.dtype(bool): torch.bool}[dtype]
    if not shared:
        return torch.empty(shape, dtype=torch_dtype)
    n_bytes = int(np.prod(shape)) * dtype.itemsize
    storage = torch.UntypedStorage._new_shared(n_bytes)  # as torch's own default_collate does
    return torch.empty(0, dtype=torch_dtype).set_(storage, 0, shape)  # type: ignore[call-overload]
