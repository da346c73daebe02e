"""Which images a folder holds, by what is in the files: phones and chats rename HEIC to JPG and back."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from model.errors import ModelError

__all__ = [
    "IMAGE_SUFFIXES",
    "ImageKind",
    "ListedImages",
    "image_kind",
    "listed_folder",
    "listed_image",
    "natural_key",
]

IMAGE_SUFFIXES = (
    ".jpg",
    ".jpeg",
    ".jpe",
    ".jfif",
    ".mpo",
    ".png",
    ".apng",
    ".webp",
    ".avif",
    ".bmp",
    ".tif",
    ".tiff",
)
_HEIC_SUFFIXES = (".heic", ".heif", ".hif")
_VIDEO_SUFFIXES = (".mov", ".mp4", ".m4v", ".mkv", ".webm", ".avi", ".mts", ".m2ts", ".3gp", ".gif")
_MJPEG_SUFFIXES = (".mjpeg", ".mjpg")  # films that begin like a JPEG

_CONVERT_HEIC = (
    "Convert to JPEG (on a Mac: sips -s format jpeg *.HEIC --out FOLDER; "
    "elsewhere: heif-convert IN.HEIC OUT.jpg)"
)


class ImageKind(Enum):
    """What the first bytes of a file say."""

    READ = "an image that is read here"
    HEIC = "an image that is not"
    OTHER = "no image, or one that is read as a video"


@dataclass(frozen=True, kw_only=True)
class ListedImages:
    """The images of one source in their order."""

    source: Path  # a folder, or the image itself
    files: tuple[Path, ...]
    notes: tuple[str, ...]


def image_kind(path: Path) -> ImageKind:
    """By the first bytes. OSError."""
    with path.open("rb") as file:
        head = file.read(32)
    if path.suffix.lower() in _MJPEG_SUFFIXES:
        return ImageKind.OTHER
    if head.startswith((b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"BM")):
        return ImageKind.READ
    if head.startswith((b"II*\0", b"MM\0*")):  # also raw photos (DNG, NEF), which Pillow shows as a thumbnail
        return ImageKind.READ if path.suffix.lower() in (".tif", ".tiff") else ImageKind.OTHER
    if head.startswith(b"RIFF") and head[8:12] == b"WEBP":
        return ImageKind.READ
    if head[4:8] != b"ftyp":
        return ImageKind.OTHER
    if b"avif" in head[8:] or b"avis" in head[8:]:
        return ImageKind.READ
    # Stills only: FFmpeg would take a tile of 512 x 512 for the film. Sequences (msf1, hevc) it reads.
    return ImageKind.HEIC if head[8:12] in (b"heic", b"heix", b"heim", b"heis", b"mif1") else ImageKind.OTHER


def listed_image(path: Path) -> ListedImages:
    """A single image. ModelError for a HEIC file."""
    if image_kind(path) is ImageKind.HEIC:
        films = [path.with_suffix(suffix) for end in _VIDEO_SUFFIXES for suffix in (end, end.upper())]
        film = next((film.name for film in films if film.is_file()), None)
        raise ModelError(
            path,
            "a HEIC image, which is not decoded here",
            expected="JPEG, PNG, WebP, AVIF, BMP or TIFF, or a video",
            action=f"Name the video beside it, {film}." if film else f"{_CONVERT_HEIC}.",
        )
    return ListedImages(source=path, files=(path,), notes=())


def listed_folder(folder: Path, entries: Sequence[Path]) -> ListedImages:
    """The images among the entries of a folder, hidden files left out; what else is there is noted.

    Raises ModelError that says what is there when there is no image. OSError.
    """
    shown = [entry for entry in entries if not entry.name.startswith(".") and not entry.is_dir()]
    files = [entry for entry in shown if entry.is_file()]
    suffixes = IMAGE_SUFFIXES + _HEIC_SUFFIXES
    named = [file for file in files if file.suffix.lower() in suffixes]
    named.sort(key=lambda file: (natural_key(file), file.name))  # A.jpg and a.jpg are alike to the first
    heic = [file for file in named if _is_heic(file)]
    images = tuple(file for file in named if file not in heic)
    others = sorted(set(files) - set(named))
    notes = []
    if heic:
        notes.append(f"{len(heic)} HEIC images were not read ({heic[0].name}, ...). {_CONVERT_HEIC}")
    if others:
        notes.append(f"files that are no images were not read: {_counted(others)}")
    if len(files) < len(shown):
        lost = sorted(entry.name for entry in set(shown) - set(files))
        notes.append(f"links that lead nowhere, and other things that are no files: {', '.join(lost[:3])}")
    if not images:
        raise _no_images(folder, heic, others)
    return ListedImages(source=folder, files=images, notes=tuple(notes))


def natural_key(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Sorts frame_2 before frame_10."""
    parts = re.findall(r"\d+|\D+", path.name)
    return tuple((0, int(part), part) if part.isdecimal() else (1, 0, part.lower()) for part in parts)


def _is_heic(file: Path) -> bool:
    """By its content; an empty or cut file by its name."""
    kind = image_kind(file)
    return kind is ImageKind.HEIC or (kind is ImageKind.OTHER and file.suffix.lower() in _HEIC_SUFFIXES)


def _counted(files: Sequence[Path]) -> str:
    counts = Counter(file.suffix.lower() or "(no suffix)" for file in files)
    return ", ".join(f"{count} {suffix}" for suffix, count in sorted(counts.items()))


def _no_images(folder: Path, heic: Sequence[Path], others: Sequence[Path]) -> ModelError:
    films = [file for file in others if file.suffix.lower() in _VIDEO_SUFFIXES]
    action = "Name a folder of frames, or a video file."
    if films:
        action = f"Name the video: {films[0]}."
    elif heic:
        action = f"{_CONVERT_HEIC}, then name that folder."
    return ModelError(
        folder,
        f"no images in this folder ({_counted([*heic, *others]) or 'it is empty'})",
        expected=f"files ending in {', '.join(IMAGE_SUFFIXES)}" + (", not HEIC" if heic else ""),
        action=action,
    )
