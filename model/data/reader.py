"""SampleReader: from a SampleKey to a TrainingSample, in a loader worker or in the main process.

Reads only the row groups of the clips that are seen and the columns that are used; of images on the
local disk only the frames that are seen. Remote clips stay in a cache bounded in bytes, the small clip
and object tables in caches bounded in number.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from model.data.batch import OCCUPANCY_VOXELS, SurfaceTarget, TrainingSample
from model.data.clip_frames import BLOB_COLUMNS, ClipFrames
from model.data.config import StreamConfig
from model.data.crop import CroppedMasks, ViewCrop, crop_image, crop_masks, draw_crop, mirrored, union_box
from model.data.index import FRAME_COLUMNS, MotionIndex, MotionRef
from model.data.order import RandomStream, SampleKey, random_stream
from shards.errors import CorruptShardError, ImageError, RowError
from shards.reader import ColumnTable
from shards.storage.bounded_cache import BoundedCache
from shards.storage.frame_pages import FramePages, local_pages

__all__ = ["SURFACE_COLUMNS", "SampleReader", "choose_views", "surface_target"]

_CORRUPT = (CorruptShardError, ImageError, RowError)
_ATTEMPTS_PER_MOTION = 4  # other views of the same motion, before another motion takes the place
_MAX_ATTEMPTS = 32
_MAX_OBJECTS = 512
_MAX_CLIP_TABLES = 64
_MAX_OPEN_FILES = 64
_NUMBER_COLUMNS = tuple(name for name in FRAME_COLUMNS if name not in BLOB_COLUMNS)
_TARGET_COLUMNS = ("T_objmesh_from_canonical", "occupancy_64")
SURFACE_COLUMNS = (
    "surface_points",
    "surface_normals",
    "surface_colors",
    "sdf_points",
    "sdf_values",
    "object_scale_m",
)
_CLIP_COLUMNS = ("clip_id", "K", "image_width", "image_height", "hand_side")


@dataclass(frozen=True, kw_only=True, eq=False)
class _Object:
    T_objmesh_from_canonical: Float[np.ndarray, "4 4"]
    voxels: UInt8[np.ndarray, "voxel 3"]
    surface: SurfaceTarget | None

    def occupancy(self) -> Bool[np.ndarray, "64 64 64"]:
        grid = np.zeros((OCCUPANCY_VOXELS,) * 3, bool)
        grid[tuple(self.voxels.T)] = True
        return grid


@dataclass(frozen=True, kw_only=True, eq=False)
class _View:
    """One view before it is stacked with the others."""

    crop: ViewCrop
    image: UInt8[np.ndarray, "size size 3"]
    masks: CroppedMasks
    T_cam_from_obj: Float[np.ndarray, "4 4"]
    joints_px: Float[np.ndarray, "21 2"]


def choose_views(motion: MotionRef, n_views: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """(clip row, frame) of `n_views` different images: any cameras, any times, all equally likely."""
    picked = rng.choice(motion.n_frames, n_views, replace=False)
    starts = np.cumsum((0, *motion.frame_counts))
    clips = np.searchsorted(starts, picked, side="right") - 1
    return [(motion.clip_rows[clip], int(i - starts[clip])) for clip, i in zip(clips, picked)]


class SampleReader:
    """Reads and augments samples; one per process, not shared between threads."""

    def __init__(self, index: MotionIndex, config: StreamConfig) -> None:
        self._index = index
        self._config = config
        self._frames: BoundedCache[ClipFrames] = BoundedCache(config.cache_mb << 20)
        self._objects: BoundedCache[_Object] = BoundedCache(_MAX_OBJECTS)
        self._page_files: BoundedCache[FramePages | None] = BoundedCache(_MAX_OPEN_FILES)
        self._clip_tables: BoundedCache[dict[str, Any]] = BoundedCache(_MAX_CLIP_TABLES)

    def read(self, key: SampleKey) -> tuple[TrainingSample, tuple[str, ...]]:
        """The sample, and one line for each corrupt row met on the way.

        A corrupt row raises its ShardError where `max_corrupt` is 0. Otherwise other views of the
        motion, then other motions take its place: a function of (seed, epoch, position) and the data.
        """
        motion = self._index.motions[key.item]
        faults: list[str] = []
        for attempt in range(_MAX_ATTEMPTS):
            views_rng, crop_rng = (
                random_stream(self._config.seed, key.epoch, key.position, stream, attempt)
                for stream in (RandomStream.VIEWS, RandomStream.CROP)
            )
            if attempt and attempt % _ATTEMPTS_PER_MOTION == 0:
                motion = self._index.motions[int(views_rng.integers(len(self._index.motions)))]
            try:
                views = choose_views(motion, key.n_views, views_rng)
                return self._sample(motion, views, crop_rng), tuple(faults)
            except _CORRUPT as error:
                if self._config.max_corrupt == 0:
                    raise
                faults.append(str(error))
        raise CorruptShardError(
            f"no readable sample in {_MAX_ATTEMPTS} attempts, the last: {faults[-1]}",
            where=self._index.shards[motion.shard].path,
            fix="verify the shards, and copy damaged ones again",
        )

    def _sample(
        self, motion: MotionRef, chosen: list[tuple[int, int]], rng: np.random.Generator
    ) -> TrainingSample:
        clips, target = self._clips(motion.shard), self._object(motion)
        flip = rng.random() < self._config.augmentation.flip_probability
        views = [self._view(motion.shard, row, frame, rng) for row, frame in chosen]
        T_cam_from_obj = np.stack([view.crop.T_crop_from_cam @ view.T_cam_from_obj for view in views])
        sample = TrainingSample(
            motion_id=motion.motion_id,
            object_uid=motion.object_uid,
            clip_ids=tuple(clips["clip_id"][row] for row, _ in chosen),
            frame_indices=np.array([frame for _, frame in chosen]),
            images=_planes([view.image for view in views]),
            object_amodal=np.stack([view.masks.object_amodal for view in views]),
            object_visible=np.stack([view.masks.object_visible for view in views]),
            hand_visible=np.stack([view.masks.hand_visible for view in views]),
            K=np.stack([view.crop.K for view in views]).astype(np.float32),
            T_cam_from_canonical=(T_cam_from_obj @ target.T_objmesh_from_canonical).astype(np.float32),
            occupancy=target.occupancy(),
            joints_px=np.stack([view.joints_px for view in views]).astype(np.float32),
            is_right=clips["hand_side"][motion.clip_rows[0]] == "right",
            surface=target.surface,
        )
        return mirrored(sample) if flip else sample

    def _view(self, shard: int, row: int, frame: int, rng: np.random.Generator) -> _View:
        clips, frames = self._clips(shard), self._clip_frames(shard, row)
        image_size = (int(clips["image_width"][row]), int(clips["image_height"][row]))
        box = union_box(frames.boxes_px(frame), image_size)
        crop = draw_crop(box, clips["K"][row], self._config.image_size, self._config.augmentation, rng)
        return _View(
            crop=crop,
            image=crop_image(frames.rgb(frame, image_size), crop),
            masks=crop_masks(frames.mask_bits(frame, image_size), crop),
            T_cam_from_obj=frames.T_cam_from_obj(frame),
            joints_px=crop.points(frames.joints_px(frame)),
        )

    def _clip_frames(self, shard: int, row: int) -> ClipFrames:
        def read() -> ClipFrames:
            clip_id, pages = self._clips(shard)["clip_id"][row], self._pages(shard)
            if pages is None:
                return ClipFrames(self._index.shards[shard].read_frames(clip_id, FRAME_COLUMNS))
            frames = self._index.shards[shard].read_frames(clip_id, _NUMBER_COLUMNS)
            return ClipFrames(frames, lambda column, frame: pages.blob(row, column, frame))

        return self._frames.get((shard, row), read, lambda frames: frames.n_bytes)

    def _pages(self, shard: int) -> FramePages | None:
        def read() -> FramePages | None:
            return local_pages(self._index.shards[shard].source("frames"), BLOB_COLUMNS)

        return self._page_files.get(shard, read, lambda _: 1)

    def _clips(self, shard: int) -> dict[str, Any]:
        def read() -> dict[str, Any]:
            table = self._index.shards[shard].read_clips(_CLIP_COLUMNS)
            return {name: table[name] for name in _CLIP_COLUMNS}

        return self._clip_tables.get(shard, read, lambda _: 1)

    def _object(self, motion: MotionRef) -> _Object:
        return self._objects.get(
            (motion.shard, motion.object_uid), lambda: self._read_object(motion), lambda _: 1
        )

    def _read_object(self, motion: MotionRef) -> _Object:
        shard, uid = self._index.shards[motion.shard], motion.object_uid
        if not shard.has_object(uid):
            raise CorruptShardError(
                "the object of a clip is missing", where=f"{shard.path}/objects.parquet", row=uid
            )
        columns = _TARGET_COLUMNS + (SURFACE_COLUMNS if self._config.surface else ())
        table = shard.read_object(uid, columns)
        voxels = table["occupancy_64"][0]
        if len(voxels) and voxels.max() >= OCCUPANCY_VOXELS:
            raise RowError("voxel outside 0..63", where=table.where)
        return _Object(
            T_objmesh_from_canonical=table["T_objmesh_from_canonical"][0],
            voxels=voxels,
            surface=surface_target(table) if self._config.surface else None,
        )


def surface_target(table: ColumnTable) -> SurfaceTarget:
    """From the row of an object with `SURFACE_COLUMNS`."""
    return SurfaceTarget(
        points=table["surface_points"][0],
        normals=table["surface_normals"][0],
        colors=table["surface_colors"][0],
        sdf_points=table["sdf_points"][0],
        sdf_values=table["sdf_values"][0],
        object_scale_m=float(table["object_scale_m"][0]),
    )


def _planes(images: list[UInt8[np.ndarray, "size size 3"]]) -> Float32[np.ndarray, "view 3 size size"]:
    """0..1, channels first."""
    size = images[0].shape[0]
    out = np.empty((len(images), 3, size, size), np.float32)
    for planes, image in zip(out, images):
        for channel in range(3):
            np.multiply(image[..., channel], np.float32(1 / 255), out=planes[channel])
    return out
