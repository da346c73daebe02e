"""GraspXL's published motions, read exactly as they are (FORMATS 2.1, 2.2).

`ROOT/mano_dataset_<n>/<size>/<object id>/mano_<k>.npy` with n = 1, 2, 3 and size small, medium or
large. World of the files: Z up, metres, table top at z = 0.5, 100 frames a second; the wrist turns
about MANO's rest wrist joint; finger angles are offsets from MANO's mean pose; betas are 0.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from datagen.input_error import InputError
from datagen.objects.stores.graspxl_objects import LICENCE, SIZES
from datagen.restricted_pickle import load_restricted_npy

__all__ = [
    "GRASPXL_FPS",
    "LICENCE",
    "SIZES",
    "RecordedMotion",
    "SequenceFile",
    "find_sequences",
    "read_sequence",
    "sequence_file",
]

GRASPXL_FPS = 100.0
_HAND = "right_hand"
_PARTS = re.compile(r"mano_dataset_\d+")
_FILES = re.compile(r"mano_\d+\.npy")
# Middle of the table top where every object starts; taken away, so that the table lies at z = 0.
_START_WORLD = np.array([1.0, 0.0, 0.5])
_LARGEST_M = 10.0  # positions beyond this are not a grasp on a table


@dataclass(frozen=True, kw_only=True)
class SequenceFile:
    """One published file. `sequence_id` is its path below the root without suffix."""

    sequence_id: str
    part: str  # mano_dataset_1
    size: str  # small, medium, large
    object_id: str  # Objaverse uid
    path: Path

    @property
    def object_uid(self) -> str:
        """The object at this size: a variant of the Objaverse object, in the same split."""
        return f"objaverse/{self.object_id}@{self.size}"


@dataclass(frozen=True, kw_only=True)
class RecordedMotion:
    """The numbers of one file; world moved so that the table top is z = 0. Metres, radians."""

    sequence_id: str
    object_uid: str
    source: Path
    hand_orientation_world: Float[np.ndarray, "frame 3"]
    hand_pose: Float[np.ndarray, "frame 45"]  # offsets from MANO's hands_mean (flat_hand_mean false)
    hand_translation_world: Float[np.ndarray, "frame 3"]  # smplx transl
    T_world_from_file: Float[np.ndarray, "frame 4 4"]  # of the object's mesh file, rigid


def find_sequences(root: Path, sizes: tuple[str, ...] = SIZES) -> tuple[SequenceFile, ...]:
    """Every sequence file below `root`, in natural order. InputError when it is not a GraspXL folder."""
    unknown = sorted(set(sizes) - set(SIZES))
    if unknown:
        raise InputError(
            "sizes", f"has {', '.join(unknown)}", expected=", ".join(SIZES), action="Correct it."
        )
    if not root.is_dir():
        raise InputError(
            root,
            "is not a folder",
            expected="the folder that holds GraspXL's mano_dataset_1 and object_dataset",
            action="Set GRASPXL or motions.graspxl_root; `datagen assets` tells how to get the data.",
        )
    found = [
        _file(part, size, folder.name, file)
        for part in _parts(root)
        for size in SIZES
        if size in sizes and (part / size).is_dir()
        for folder in sorted((part / size).iterdir())
        if folder.is_dir()
        for file in sorted(folder.iterdir(), key=_natural)
        if _FILES.fullmatch(file.name)
    ]
    if not found:
        raise InputError(
            root,
            f"holds no sequence of size {', '.join(sizes)} (found: {_listing(root)})",
            expected="mano_dataset_<n>/<size>/<object id>/mano_<k>.npy",
            action="Name the folder into which the zip files were unpacked.",
        )
    return tuple(found)


def sequence_file(root: Path, sequence_id: str) -> SequenceFile:
    """The file of one sequence, without listing the whole data set. InputError when it is not there."""
    part_name, size, object_id, stem = sequence_id.split("/")
    part = next((part for part in _parts(root) if part.name == part_name), root / part_name)
    path = part / size / object_id / f"{stem}.npy"
    if not path.is_file():
        raise InputError(
            path,
            "does not exist",
            expected=f"sequence {sequence_id} of the plan",
            action="Copy the whole GraspXL folder to this machine, or correct GRASPXL.",
        )
    return _file(part, size, object_id, path)


def read_sequence(file: SequenceFile) -> RecordedMotion:
    """Read and check one file, without executing anything it may hold.

    InputError names file, key, expected and found. Any number of frames from 2 on.
    """
    content = load_restricted_npy(file.path)
    if not isinstance(content, dict):
        raise _wrong(
            file,
            f"holds a {type(content).__name__}",
            f"a dictionary with the keys {_HAND!r} and {file.object_id!r}",
        )
    expected = {_HAND, file.object_id}
    if set(content) != expected:
        raise _wrong(
            file,
            f"has the keys {sorted(map(str, content))}",
            f"{sorted(expected)} (the second is the name of its folder)",
        )
    hand, obj = content[_HAND], content[file.object_id]
    orientation = _array(file, _HAND, hand, "rot", 3)
    n_frames = len(orientation)
    pose = _array(file, _HAND, hand, "pose", 45, n_frames)
    translation = _array(file, _HAND, hand, "trans", 3, n_frames)
    T_world_from_file = np.tile(np.eye(4), (n_frames, 1, 1))
    rotation = _array(file, file.object_id, obj, "rot", 3, n_frames)
    T_world_from_file[:, :3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    T_world_from_file[:, :3, 3] = _array(file, file.object_id, obj, "trans", 3, n_frames) - _START_WORLD
    _refuse_articulated(file, obj, n_frames)
    for name, positions in (("trans", translation), ("object trans", T_world_from_file[:, :3, 3])):
        if np.abs(positions).max() > _LARGEST_M:
            raise _wrong(
                file, f"{name} reaches {np.abs(positions).max():.1f}", f"metres, at most {_LARGEST_M:g}"
            )
    return RecordedMotion(
        sequence_id=file.sequence_id,
        object_uid=file.object_uid,
        source=file.path,
        hand_orientation_world=orientation,
        hand_pose=pose,
        hand_translation_world=translation - _START_WORLD,
        T_world_from_file=T_world_from_file,
    )


def _file(part: Path, size: str, object_id: str, path: Path) -> SequenceFile:
    return SequenceFile(
        sequence_id=f"{part.name}/{size}/{object_id}/{path.stem}",
        part=part.name,
        size=size,
        object_id=object_id,
        path=path,
    )


def _parts(root: Path) -> list[Path]:
    """The mano_dataset_<n> folders: below `root`, below its dataset_example, or `root` itself."""
    if _PARTS.fullmatch(root.name) and any((root / size).is_dir() for size in SIZES):
        return [root]
    for base in (root, root / "dataset_example"):
        parts = (
            [p for p in base.iterdir() if p.is_dir() and _PARTS.fullmatch(p.name)] if base.is_dir() else []
        )
        if parts:
            # Unzipping into a folder of the zip's own name nests it once more.
            return [
                part / part.name if (part / part.name).is_dir() else part
                for part in sorted(parts, key=_natural)
            ]
    return []


def _array(
    file: SequenceFile, owner: str, table: Any, key: str, width: int, n_frames: int | None = None
) -> Float[np.ndarray, "frame width"]:
    where = f"{owner}.{key}"
    if not isinstance(table, dict) or key not in table:
        found = sorted(map(str, table)) if isinstance(table, dict) else type(table).__name__
        raise _wrong(file, f"lacks {where} (found {found})", f"an array of shape (frames, {width})")
    values = table[key]
    if not isinstance(values, np.ndarray) or values.dtype.kind != "f":
        kind = getattr(values, "dtype", type(values).__name__)
        raise _wrong(file, f"{where} is {kind}", f"floats of shape (frames, {width})")
    frames = "frames" if n_frames is None else str(n_frames)
    rows_fit = values.ndim == 2 and len(values) >= 2 and n_frames in (None, len(values))
    if not rows_fit or values.shape[1] != width:
        raise _wrong(file, f"{where} has shape {values.shape}", f"({frames}, {width}), at least 2 frames")
    if not np.isfinite(values).all():
        frame = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
        raise _wrong(file, f"{where} is not finite in frame {frame}", "finite numbers")
    return values.astype(np.float64)


def _refuse_articulated(file: SequenceFile, obj: dict[str, Any], n_frames: int) -> None:
    angle = _array(file, file.object_id, obj, "angle", 1, n_frames)
    if np.abs(angle).max() > 1e-6:
        raise _wrong(
            file,
            f"{file.object_id}.angle reaches {np.abs(angle).max():.3f} rad (an articulated object)",
            "0, a rigid object",
        )


def _wrong(file: SequenceFile, problem: str, expected: str) -> InputError:
    return InputError(
        file.path, problem, expected=expected, action="Unpack the file again from GraspXL's zip."
    )


def _natural(path: Path) -> tuple[int | str, ...]:
    return tuple(int(word) if word.isdecimal() else word for word in re.split(r"(\d+)", path.name))


def _listing(root: Path) -> str:
    names = sorted(path.name for path in root.iterdir())
    return ", ".join(names[:6]) + (", ..." if len(names) > 6 else "") if names else "nothing"
