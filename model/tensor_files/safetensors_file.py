"""Safetensors files: written whole or not at all; read header first, tensors when they are known to fit."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from model.errors import ModelError
from model.tensor_files.file_content import check_file, mistaken_for
from shards.storage.whole_file import write_whole

__all__ = [
    "Header",
    "KeyComparison",
    "check_finite",
    "check_floats",
    "compare_keys",
    "read_header",
    "read_tensors",
    "shapes_of",
    "write_tensors",
]

_FLOATS = ("F32", "F16", "BF16")
_NAMED = 3  # keys of each kind that an error names

Shapes = Mapping[str, tuple[int, ...]]


@dataclass(frozen=True, kw_only=True)
class Header:
    """What a file holds, without its tensors."""

    shapes: dict[str, tuple[int, ...]]
    metadata: dict[str, str]


@dataclass(frozen=True, kw_only=True)
class KeyComparison:
    """Keys of a file against the tensors of a module.

    `used` fit; `missing` are in the module only; `unused` are in the file only; `mismatched` are in both with other
    shapes, and say which.
    """

    used: tuple[str, ...]
    missing: tuple[str, ...]
    unused: tuple[str, ...]
    mismatched: tuple[str, ...]

    @property
    def complete(self) -> bool:
        """Whether the file fits the module exactly."""
        return not (self.missing or self.unused or self.mismatched)

    def problem(self) -> str:
        """What does not fit, in one line: how many keys of each kind, and the first of them by name."""
        kinds = {"missing": self.missing, "unused": self.unused, "of another shape": self.mismatched}
        return ", ".join(f"{len(names)} {kind}{_first(names)}" for kind, names in kinds.items())


def _first(names: Sequence[str]) -> str:
    more = " ..." if len(names) > _NAMED else ""
    return f" ({'; '.join(names[:_NAMED])}{more})" if names else ""


def shapes_of(module: nn.Module) -> dict[str, tuple[int, ...]]:
    """Names and shapes of what a module saves."""
    return {name: tuple(tensor.shape) for name, tensor in module.state_dict().items()}


def compare_keys(found: Shapes, wanted: Shapes) -> KeyComparison:
    """Names and shapes of a file against those of a module."""
    common = wanted.keys() & found.keys()
    return KeyComparison(
        used=tuple(name for name in wanted if name in common and wanted[name] == found[name]),
        missing=tuple(name for name in wanted if name not in found),
        unused=tuple(sorted(found.keys() - wanted.keys())),
        mismatched=tuple(
            f"{name} {found[name]} in the file, {wanted[name]} in the module"
            for name in wanted
            if name in common and wanted[name] != found[name]
        ),
    )


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: dict[str, str] | None = None) -> None:
    """The file appears whole or not at all; several processes may write the same."""
    path.parent.mkdir(parents=True, exist_ok=True)
    saved = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    with write_whole(path) as partial:
        save_file(saved, partial, metadata=metadata)


def read_header(path: Path, *, expected: str, action: str, ours: bool = False) -> Header:
    """Names, shapes and metadata. ModelError when the file is missing, torn, or holds anything but floats.

    `action` is what helps where nothing better is known; of a file of `ours`, always.
    """
    check_file(path, expected=expected, action=action)
    try:
        with safe_open(str(path), framework="pt") as file:
            slices = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118
            shapes = {name: tuple(part.get_shape()) for name, part in slices.items()}
            dtypes = {name: part.get_dtype() for name, part in slices.items()}
            metadata = file.metadata() or {}
    except (OSError, SafetensorError) as error:
        mistaken = mistaken_for(path)
        reason = " ".join(str(error).split()) if mistaken is None else mistaken.what
        action = action if mistaken is None or ours else mistaken.action
        raise ModelError(
            path, f"is no complete safetensors file ({reason})", expected=expected, action=action
        ) from error
    check_floats(path, dtypes)
    return Header(shapes=shapes, metadata=metadata)


def check_floats(path: Path, dtypes: Mapping[str, str]) -> None:
    """ModelError unless all tensors have a number format that is trained, by the names of safetensors."""
    if odd := [f"{name} as {dtype}" for name, dtype in dtypes.items() if dtype not in _FLOATS]:
        raise ModelError(
            path,
            f"stores {odd[0]} ({len(odd)} such tensors)",
            expected=f"floating-point weights ({', '.join(_FLOATS)})",
            action="Quantised weights cannot be trained: use the original file, or save wider floats as float32.",
        )


def read_tensors(path: Path, names: Mapping[str, str]) -> dict[str, Tensor]:
    """Tensors of the file as stored, renamed: `names` gives the new name of each. ModelError when one is not finite."""
    with safe_open(str(path), framework="pt") as file:
        tensors = {new: file.get_tensor(name) for name, new in names.items()}
    check_finite(path, tensors)
    return tensors


def check_finite(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """ModelError when a tensor holds NaN or infinity."""
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise ModelError(
                path,
                f"{name} holds NaN or infinity",
                expected="finite weights",
                action="The file is damaged: copy it again.",
            )
