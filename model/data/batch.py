"""TrainingSample (one motion, several views) and Batch: what the network is fed.

Frames: *canonical* is the object's unit cube (shards/README.md), *cam* the OpenCV camera of a view after
its crop, roll and mirror. `K` belongs to the crop: pixels, image corner at (0, 0).
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, UInt8

from model.errors import ModelError

__all__ = [
    "OCCUPANCY_VOXELS",
    "Batch",
    "SurfaceBatch",
    "SurfaceTarget",
    "TrainingSample",
    "join_surfaces",
    "stack_samples",
]

OCCUPANCY_VOXELS = 64


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceTarget:
    """Samples of an object's true surface and of its signed distance; canonical frame and unit."""

    points: Float32[np.ndarray, "surface 3"]
    normals: Float32[np.ndarray, "surface 3"]  # outward, unit
    colors: UInt8[np.ndarray, "surface 3"]  # sRGB base colour, unshaded
    sdf_points: Float32[np.ndarray, "sample 3"]
    sdf_values: Float32[np.ndarray, " sample"]  # negative inside
    object_scale_m: float  # metres per canonical unit
    is_mirrored: bool = False  # x -> -x of the object that the shard holds


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingSample:
    """Some views of one motion, cropped, with the targets of all of them."""

    motion_id: str
    object_uid: str
    clip_ids: tuple[str, ...]  # one per view
    frame_indices: Int[np.ndarray, " view"]
    images: Float32[np.ndarray, "view 3 size size"]  # sRGB, 0..1; 0 outside the rendered image
    object_amodal: Bool[np.ndarray, "view size size"]
    object_visible: Bool[np.ndarray, "view size size"]
    hand_visible: Bool[np.ndarray, "view size size"]  # hand, forearm and sleeve
    K: Float32[np.ndarray, "view 3 3"]
    T_cam_from_canonical: Float32[np.ndarray, "view 4 4"]  # similarity: canonical cube to camera metres
    occupancy: Bool[np.ndarray, "64 64 64"]  # [i, j, k] along x, y, z of the canonical frame
    joints_px: Float32[np.ndarray, "view 21 2"]  # NaN behind the camera
    is_right: bool
    surface: SurfaceTarget | None = None  # read only where StreamConfig.surface asks for it


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceBatch:
    """`SurfaceTarget` of several samples, their rows one after another: objects may have different numbers of them."""

    points: Float[torch.Tensor, "surface 3"]
    normals: Float[torch.Tensor, "surface 3"]
    colors: UInt8[torch.Tensor, "surface 3"]
    sdf_points: Float[torch.Tensor, "sample 3"]
    sdf_values: Float[torch.Tensor, " sample"]
    point_counts: tuple[int, ...]  # rows of `points` of each sample
    sdf_counts: tuple[int, ...]
    object_uids: tuple[str, ...]
    object_scales_m: tuple[float, ...]
    are_mirrored: tuple[bool, ...]

    def part(self, start: int, stop: int) -> "SurfaceBatch":
        """The samples start .. stop - 1."""
        chosen = slice(start, stop)
        points = slice(sum(self.point_counts[:start]), sum(self.point_counts[:stop]))
        samples = slice(sum(self.sdf_counts[:start]), sum(self.sdf_counts[:stop]))
        return SurfaceBatch(
            points=self.points[points],
            normals=self.normals[points],
            colors=self.colors[points],
            sdf_points=self.sdf_points[samples],
            sdf_values=self.sdf_values[samples],
            point_counts=self.point_counts[chosen],
            sdf_counts=self.sdf_counts[chosen],
            object_uids=self.object_uids[chosen],
            object_scales_m=self.object_scales_m[chosen],
            are_mirrored=self.are_mirrored[chosen],
        )

    def to(self, device: torch.device | str) -> "SurfaceBatch":
        """On `device`, float32."""
        names = [f.name for f in fields(self) if isinstance(getattr(self, f.name), torch.Tensor)]
        return replace(self, **{name: getattr(self, name).to(device, non_blocking=True) for name in names})


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
    is_right: Bool[torch.Tensor, " batch"]
    ids: tuple[str, ...]  # "motion_id:epoch:position", one per sample
    views: tuple[tuple[str, ...], ...] = ()  # "clip_id frame N" of each view, by sample; empty: of no shard
    surface: SurfaceBatch | None = None  # read only where StreamConfig.surface asks for it

    @property
    def names(self) -> tuple[str, ...]:
        """What each sample is and what it shows, for a person who looks for it."""
        if not self.views:
            return self.ids
        return tuple(f"{name} ({', '.join(views)})" for name, views in zip(self.ids, self.views, strict=True))

    @property
    def true_surface(self) -> SurfaceBatch:
        """`surface` where it was read; ModelError otherwise."""
        if self.surface is None:
            raise ModelError(
                "batch",
                "comes without the objects' surfaces",
                expected="a stream that reads them",
                action="Set `surface` in its StreamConfig.",
            )
        return self.surface

    def part(self, start: int, stop: int) -> "Batch":
        """The samples start .. stop - 1."""
        rows = {f.name: getattr(self, f.name)[start:stop] for f in fields(self) if f.name != "surface"}
        return Batch(**rows, surface=None if self.surface is None else self.surface.part(start, stop))

    def to(self, device: torch.device | str, dtype: torch.dtype) -> "Batch":
        """On `device`, with images as `dtype`.

        Geometry keeps float32: bfloat16 holds a pixel position only to about one pixel in 256.
        """
        moved = {
            f.name: getattr(self, f.name).to(device, non_blocking=True)
            for f in fields(self)
            if f.name not in _NOT_STACKED
        }
        moved["images"] = moved["images"].to(dtype)
        surface = None if self.surface is None else self.surface.to(device)
        return replace(self, **moved, surface=surface)


_NOT_STACKED = ("ids", "views", "surface")


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

    surfaces = [sample.surface for sample in samples if sample.surface is not None]
    return Batch(
        **{f.name: stacked(f.name) for f in fields(Batch) if f.name not in _NOT_STACKED},
        ids=tuple(ids),
        views=tuple(
            tuple(f"{clip} frame {frame}" for clip, frame in zip(sample.clip_ids, sample.frame_indices))
            for sample in samples
        ),
        surface=join_surfaces(surfaces, [s.object_uid for s in samples], shared=shared) if surfaces else None,
    )


def join_surfaces(
    surfaces: Sequence[SurfaceTarget], object_uids: Sequence[str], *, shared: bool = False
) -> SurfaceBatch:
    """The surfaces of a batch, in order; `shared` as in `stack_samples`."""

    def joined(name: str) -> torch.Tensor:
        arrays = [getattr(surface, name) for surface in surfaces]
        out = _empty((sum(map(len, arrays)), *arrays[0].shape[1:]), arrays[0].dtype, shared=shared)
        np.concatenate(arrays, out=out.numpy())
        return out

    names = ("points", "normals", "colors", "sdf_points", "sdf_values")
    return SurfaceBatch(
        **{name: joined(name) for name in names},
        point_counts=tuple(len(surface.points) for surface in surfaces),
        sdf_counts=tuple(len(surface.sdf_points) for surface in surfaces),
        object_uids=tuple(object_uids),
        object_scales_m=tuple(surface.object_scale_m for surface in surfaces),
        are_mirrored=tuple(surface.is_mirrored for surface in surfaces),
    )


def _empty(shape: tuple[int, ...], dtype: np.dtype, *, shared: bool) -> torch.Tensor:
    torch_dtype = {
        np.dtype(np.float32): torch.float32,
        np.dtype(bool): torch.bool,
        np.dtype(np.uint8): torch.uint8,
    }[dtype]
    if not shared:
        return torch.empty(shape, dtype=torch_dtype)
    n_bytes = int(np.prod(shape)) * dtype.itemsize
    storage = torch.UntypedStorage._new_shared(n_bytes)  # as torch's own default_collate does
    tensor = torch.empty(0, dtype=torch_dtype)
    tensor.set_(storage, 0, shape)  # type: ignore[call-overload]
    return tensor
