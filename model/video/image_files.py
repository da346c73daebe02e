"""Images of a folder, or a single one, also one that moves, through Pillow, which refuses cut files."""

import struct
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

from model.errors import ModelError
from model.video.frames import (
    FIRST_ONLY,
    TRANSPARENT,
    TURNED_BY_EXIF,
    ReadLimits,
    VideoFrame,
    VideoFrames,
    checked_indices,
    even_positions,
    over_black,
    scaled_down,
)
from model.video.image_listing import ListedImages
from model.video.orientation import EXIF_MATRICES, upright
from shards.printable import printable

__all__ = ["read_images"]

# Whatever the suffix says. Without a list Pillow tries all that it has a plugin for, and EPS starts Ghostscript.
_FORMATS = ("JPEG", "PNG", "WEBP", "AVIF", "BMP", "TIFF", "GIF")
_ANIMATED_FORMATS = ("PNG", "WEBP", "AVIF", "GIF")
_EXIF_ORIENTATION = 0x0112

# Phones take 108 megapixels, which are 400 MB in memory. Pillow's own limit is 179.
_MAX_PIXELS = 1 << 27

# What Pillow raises for damaged files.
_DAMAGE = (
    OSError,
    ValueError,
    SyntaxError,
    EOFError,
    LookupError,
    TypeError,
    ArithmeticError,
    struct.error,
    Image.DecompressionBombError,
)


def read_images(listed: ListedImages, limits: ReadLimits, indices: Sequence[int] | None) -> VideoFrames:
    """The images `indices`, or candidates spread over them; of a single animated image its frames.

    Damaged candidates are left out and named in the notes. Raises ModelError when a frame that was asked
    for is damaged or does not exist, or when all are.
    """
    if len(listed.files) == 1 and (n := _frames_of_animation(listed.files[0])) > 1:
        return _read_animation(listed.files[0], n, limits, indices)
    n = len(listed.files)
    wanted = even_positions(n, limits.max_frames)
    if indices is not None:
        wanted = checked_indices(indices, n, str(listed.source))
    frames, damaged = [], []
    for index in wanted:
        try:
            frames.append(_read(listed.files[index], index, limits))
        except ModelError as error:
            if indices is not None:
                raise
            damaged.append(error)
    if not frames:
        raise damaged[0]
    return VideoFrames(
        source=str(listed.source),
        kind="images",
        frames=tuple(frames),
        n_source_frames=n,
        notes=(*listed.notes, *_note_of_damage(damaged, len(wanted))),
    )


def _read(path: Path, index: int, limits: ReadLimits) -> VideoFrame:
    changes: list[str] = []
    with _opened(path) as image:
        if image.format != "MPO" and getattr(image, "n_frames", 1) > 1:
            changes.append(FIRST_ONLY)
        stored_size = image.size
        image.draft("RGB", (limits.max_side_px, limits.max_side_px))  # JPEG: decodes a smaller one
        is_draft = image.size != stored_size
        image.load()  # Pillow turns a TIFF upright here
        size = stored_size if is_draft else image.size
        return _upright_frame(image, size, index, float("nan"), printable(path.name), changes, limits)


def _frames_of_animation(path: Path) -> int:
    """1 for what does not move. The image for viewers that know no animation (PNG) is not one of them."""
    with _opened(path) as image:
        if image.format not in _ANIMATED_FORMATS:
            return 1
        return int(getattr(image, "n_frames", 1)) - bool(getattr(image, "default_image", False))


def _read_animation(path: Path, n: int, limits: ReadLimits, indices: Sequence[int] | None) -> VideoFrames:
    """Frames build on those before them, so all up to the last wanted one are decoded, or up to damage."""
    wanted = even_positions(n, limits.max_frames)
    if indices is not None:
        wanted = checked_indices(indices, n, str(path))
    frames: list[VideoFrame] = []
    time_ms = 0.0
    with _opened(path) as image:
        first = int(getattr(image, "n_frames", 1)) - n
        for index in range(wanted[-1] + 1):
            try:
                image.seek(first + index)
                image.load()
            except _DAMAGE:
                if indices is not None or not frames:
                    raise
                break
            if index in wanted:
                name, time_s = f"frame {index}", time_ms / 1000.0
                frames.append(_upright_frame(image, image.size, index, time_s, name, [], limits))
            time_ms += image.info.get("duration", 0.0)
    if time_ms == 0.0:  # shown as fast as can be
        frames = [replace(frame, time_s=float("nan")) for frame in frames]
    missing = len(wanted) - len(frames)
    note = f"{missing} of {len(wanted)} candidate frames cannot be decoded and are left out"
    return VideoFrames(
        source=str(path),
        kind="video",
        frames=tuple(frames),
        n_source_frames=n,
        notes=(note,) if missing else (),
    )


def _upright_frame(
    image: Image.Image,
    stored_size: tuple[int, int],
    index: int,
    time_s: float,
    name: str,
    changes: list[str],
    limits: ReadLimits,
) -> VideoFrame:
    """Of an image that is loaded. `stored_size`: (width, height) before Pillow scaled it down."""
    pixels = scaled_down(_rgb(image, changes), limits.max_side_px)
    size = (pixels.shape[1], pixels.shape[0])
    if size != stored_size:
        changes.append(f"scaled down from {stored_size[0]} x {stored_size[1]} to {size[0]} x {size[1]}")
    matrix = EXIF_MATRICES.get(_orientation(image))
    if matrix is not None:
        changes.append(TURNED_BY_EXIF)
        pixels = upright(pixels, np.array(matrix))
        stored_size = stored_size if matrix[0][0] else stored_size[::-1]
    return VideoFrame(
        image=pixels,
        index=index,
        time_s=time_s,
        name=name,
        source_size=stored_size,
        changes=tuple(changes),
    )


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """The image, not decoded yet. ModelError for what is damaged or too large, also within the block."""
    try:
        with warnings.catch_warnings():
            # Pillow's limit of pixels is not the one here.
            warnings.simplefilter("ignore")
            opened = Image.open(path, formats=_FORMATS)
        with opened:
            if opened.width * opened.height > _MAX_PIXELS:
                raise _too_large(path, f"{opened.width} x {opened.height} pixels")
            yield opened
    except ModelError:
        raise
    except Image.DecompressionBombError as error:
        raise _too_large(path, "more than 179 megapixels") from error
    except _DAMAGE as error:
        kind = "not an image" if isinstance(error, UnidentifiedImageError) else f"damaged ({error})"
        raise ModelError(
            path,
            f"the image cannot be read: {kind}",
            expected="an intact JPEG, PNG, WebP, AVIF, BMP or TIFF file",
            action="Replace it, or take it out of the folder.",
        ) from error


def _too_large(path: Path, found: str) -> ModelError:
    return ModelError(
        path,
        f"the image cannot be read: {found}",
        expected=f"at most {_MAX_PIXELS / 1e6:.0f} megapixels",
        action="Scale it down.",
    )


def _orientation(image: Image.Image) -> int:
    """As EXIF (or XMP) says; 1 where it is broken."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            value = image.getexif().get(_EXIF_ORIENTATION)
    except _DAMAGE:
        return 1
    return value if isinstance(value, int) else 1


def _rgb(image: Image.Image, changes: list[str]) -> UInt8[np.ndarray, "height width 3"]:
    if image.mode == "F":
        raise ValueError("its pixels are floating-point numbers of unknown range")
    if image.mode.startswith("I"):
        # Pillow's own conversion cuts 16-bit values off at 255.
        changes.extend(("reduced to 8 bits", "grey copied to three channels"))
        grey = (np.asarray(image).astype(np.int64) >> 8).clip(0, 255).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=-1)
    if image.has_transparency_data:
        rgba = np.asarray(image.convert("RGBA"))
        if rgba[..., 3].min() < 255:
            changes.append(TRANSPARENT)
        return over_black(rgba)
    if image.mode in ("L", "1"):
        changes.append("grey copied to three channels")
    elif image.mode != "RGB":
        changes.append(f"converted from {image.mode} to RGB")
    return np.array(image.convert("RGB"))


def _note_of_damage(damaged: Sequence[ModelError], n: int) -> list[str]:
    if not damaged:
        return []
    first = damaged[0]
    others = f", and {len(damaged) - 1} more" if len(damaged) > 1 else ""
    return [f"{len(damaged)} of {n} images are left out: {Path(first.source).name}: {first.problem}{others}"]
