"""Images of a folder, or a single one, through Pillow, which refuses cut files."""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageOps, UnidentifiedImageError

from model.errors import ModelError
from model.video.frames import (
    ReadLimits,
    VideoFrame,
    VideoFrames,
    checked_indices,
    even_positions,
    over_black,
    scaled_down,
)

__all__ = ["IMAGE_SUFFIXES", "natural_key", "read_images"]

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")
_EXIF_ORIENTATION = 0x0112


def read_images(
    folder: Path, files: Sequence[Path], limits: ReadLimits, indices: Sequence[int] | None
) -> VideoFrames:
    """The images `indices` of `files`, or candidates spread over them.

    Files that are no images are counted in the notes. Raises ModelError when there is none, when one
    is damaged, or when a frame asked for does not exist.
    """
    images = sorted((f for f in files if f.suffix.lower() in IMAGE_SUFFIXES), key=natural_key)
    others = Counter(f.suffix.lower() or "(no suffix)" for f in files if f not in set(images))
    listed = ", ".join(f"{count} {suffix}" for suffix, count in sorted(others.items()))
    if not images:
        raise ModelError(
            folder,
            f"no images in this folder ({listed or 'it is empty'})",
            expected=f"files ending in {', '.join(IMAGE_SUFFIXES)}",
            action="Name a folder of frames, or a video file.",
        )
    n = len(images)
    wanted = even_positions(n, limits.max_frames)
    if indices is not None:
        wanted = checked_indices(indices, n, str(folder))
    return VideoFrames(
        source=str(folder),
        kind="images",
        frames=tuple(_read(images[index], index, limits) for index in wanted),
        n_source_frames=n,
        notes=(f"files that are no images were not read: {listed}",) if others else (),
    )


def natural_key(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Sorts frame_2 before frame_10."""
    parts = re.findall(r"\d+|\D+", path.name)
    return tuple((0, int(part), part) if part.isdecimal() else (1, 0, part.lower()) for part in parts)


def _read(path: Path, index: int, limits: ReadLimits) -> VideoFrame:
    changes: list[str] = []
    try:
        with Image.open(path) as opened:
            is_turned = opened.getexif().get(_EXIF_ORIENTATION, 1) != 1
            source_size = _upright_size(opened)
            opened.draft("RGB", (limits.max_side_px, limits.max_side_px))  # JPEG: decodes a smaller one
            upright_image = ImageOps.exif_transpose(opened) if is_turned else opened
            full = _rgb(upright_image, changes)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        kind = "not an image" if isinstance(error, UnidentifiedImageError) else f"damaged ({error})"
        raise ModelError(
            path,
            f"the image cannot be read: {kind}",
            expected="an intact JPEG, PNG or WebP file",
            action="Replace it, or take it out of the folder.",
        ) from error
    if is_turned:
        changes.append("turned upright as its EXIF data say")
    image = scaled_down(full, limits.max_side_px)
    if (image.shape[1], image.shape[0]) != source_size:
        old, new = source_size, (image.shape[1], image.shape[0])
        changes.append(f"scaled down from {old[0]} x {old[1]} to {new[0]} x {new[1]}")
    return VideoFrame(
        image=image,
        index=index,
        time_s=float("nan"),
        name=path.name,
        source_size=source_size,
        changes=tuple(changes),
    )


def _upright_size(image: Image.Image) -> tuple[int, int]:
    """(width, height) after the turn that the EXIF data ask for; 5 to 8 swap the axes."""
    width, height = image.size
    return (height, width) if image.getexif().get(_EXIF_ORIENTATION, 1) >= 5 else (width, height)


def _rgb(image: Image.Image, changes: list[str]) -> UInt8[np.ndarray, "height width 3"]:
    if image.mode.startswith("I"):
        # Pillow's own conversion cuts 16-bit values off at 255.
        changes.extend(("reduced to 8 bits", "grey copied to three channels"))
        grey = (np.asarray(image).astype(np.int64) >> 8).clip(0, 255).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=-1)
    if image.has_transparency_data:
        rgba = np.asarray(image.convert("RGBA"))
        if rgba[..., 3].min() < 255:
            changes.append("transparency laid over black")
        return over_black(rgba)
    if image.mode in ("L", "1"):
        changes.append("grey copied to three channels")
    elif image.mode != "RGB":
        changes.append(f"converted from {image.mode} to RGB")
    return np.array(image.convert("RGB"))
