"""ClipFrames: what a loader keeps of one clip, numbers as arrays and images still encoded."""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from model.data.index import FRAME_COLUMNS
from shards.errors import ImageError, RowError
from shards.reader import Frames

__all__ = ["BLOB_COLUMNS", "ClipFrames"]

BLOB_COLUMNS = ("rgb", "masks")


class ClipFrames:
    """The columns FRAME_COLUMNS of one clip. `where` names file and clip in errors.

    `fetch_blob` (column, frame) gets one encoded image where `frames` were read without them.
    """

    def __init__(
        self, frames: Frames, fetch_blob: Callable[[str, int], bytes | memoryview] | None = None
    ) -> None:
        self.where = frames.where
        self.n_bytes = frames.arrow.nbytes
        self.n_frames = len(frames)
        self._numbers = {name: frames[name] for name in FRAME_COLUMNS if name not in BLOB_COLUMNS}
        self._fetch_blob = fetch_blob
        self._blobs = (
            {} if fetch_blob else {name: frames.arrow[name].combine_chunks() for name in BLOB_COLUMNS}
        )

    def encoded(self, column: str, frame: int) -> bytes | memoryview:
        """Bytes of one image, "rgb" or "masks". Raises RowError, CorruptShardError."""
        if frame >= self.n_frames:
            raise RowError(
                "no such frame", where=self.where, row=f"frame {frame}", found=f"{self.n_frames} frames"
            )
        if self._fetch_blob is not None:
            return self._fetch_blob(column, frame)
        return memoryview(self._blobs[column][frame].as_buffer())

    def T_cam_from_obj(self, frame: int) -> Float[np.ndarray, "4 4"]:
        """Object's mesh frame to camera, metres."""
        return self._numbers["T_cam_from_world"][frame] @ self._numbers["T_world_from_obj"][frame]

    def joints_px(self, frame: int) -> Float[np.ndarray, "21 2"]:
        """Projected joints in image pixels; NaN behind the camera."""
        return self._numbers["joints_px"][frame].astype(np.float64)

    def boxes_px(self, frame: int) -> Int[np.ndarray, "2 4"]:
        """Boxes of the visible hand and of the amodal object, image pixels; -1 when empty."""
        boxes = [self._numbers[name][frame] for name in ("hand_box_visible_px", "object_box_amodal_px")]
        return np.stack(boxes)

    def rgb(self, frame: int, image_size: tuple[int, int]) -> UInt8[np.ndarray, "height width 3"]:
        """sRGB pixels of a PNG, JPEG or WebP. Raises ImageError."""
        flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
        return self._decoded("rgb", frame, image_size, flags)

    def mask_bits(self, frame: int, image_size: tuple[int, int]) -> UInt8[np.ndarray, "height width"]:
        """Mask bits of every pixel (shards.images.MASK_BITS). Raises ImageError."""
        return self._decoded("masks", frame, image_size, cv2.IMREAD_GRAYSCALE)

    def _decoded(self, column: str, frame: int, image_size: tuple[int, int], flags: int) -> np.ndarray:
        # OpenCV decodes PNG faster than shards.images and refuses every damaged one (200 of 200 flipped
        # bits); JPEG and WebP have no checksum, but the CRC-32 in the file was checked on reading.
        data = np.frombuffer(self.encoded(column, frame), np.uint8)
        pixels = cv2.imdecode(data, flags) if len(data) else None
        if pixels is None or pixels.shape[:2] != image_size[::-1]:
            expected = f"an image of {image_size[0]} x {image_size[1]}"
            found = "bytes that do not decode" if pixels is None else f"{pixels.shape[1]} x {pixels.shape[0]}"
            raise ImageError(
                "damaged image",
                where=self.where,
                row=f"frame {frame}",
                column=column,
                expected=expected,
                found=found,
            )
        return pixels
