"""Tensors out of a file of torch.save, by torch's restricted loader: tensors and plain containers, no code runs."""

import re
import zipfile
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from model.errors import ModelError
from model.tensor_files.file_content import check_file, content_of, mistaken_for
from model.tensor_files.safetensors_file import check_floats

__all__ = ["is_torchscript", "read_torch_tensors"]

_NESTED = ("state_dict", "model")  # where other trainers put the tensors, beside what else they save
_FORMATS = {torch.float32: "F32", torch.float16: "F16", torch.bfloat16: "BF16", torch.float64: "F64"}


def read_torch_tensors(path: Path, *, expected: str, action: str) -> dict[str, Tensor]:
    """The state dict in a file of torch.save, on the CPU; mapped from the file where its format allows it.

    ModelError when the file is none, when it names anything but tensors, or holds other values or number formats.
    """
    check_file(path, expected=expected, action=action)
    if content_of(path) != "torch":
        mistaken = mistaken_for(path)
        raise ModelError(
            path,
            f"is no file of torch.save ({mistaken.what})" if mistaken else "is no file of torch.save",
            expected=expected,
            action=mistaken.action if mistaken else action,
        )
    is_zip = zipfile.is_zipfile(path)
    if is_zip and is_torchscript(path):
        raise ModelError(path, "is a TorchScript program", expected=expected, action=action)
    try:
        content = torch.load(path, map_location="cpu", mmap=is_zip, weights_only=True)
    except Exception as error:  # broken files raise nearly anything
        raise ModelError(path, _refusal(error), expected=expected, action=action) from error
    tensors = _state_dict(path, content, expected=expected, action=action)
    check_floats(
        path, {name: _FORMATS.get(tensor.dtype, str(tensor.dtype)) for name, tensor in tensors.items()}
    )
    return tensors


def is_torchscript(path: Path) -> bool:
    """Whether a zip archive is a TorchScript program, which torch.load would compile."""
    with zipfile.ZipFile(path) as archive:
        return any(name.endswith("/constants.pkl") for name in archive.namelist())


def _refusal(error: Exception) -> str:
    """One line of ours: torch's own tells how to run the file's code."""
    text = str(error)
    if named := re.search(r"GLOBAL (\S+)", text):
        return f"names {named[1]}, and nothing but tensors is read from a file"
    if "eights only load failed" in text:
        return "holds more than tensors, and nothing else is read from a file"
    return f"cannot be read ({' '.join(text.split())[:120] or type(error).__name__})"


def _state_dict(path: Path, content: object, *, expected: str, action: str) -> dict[str, Tensor]:
    held = content
    for name in _NESTED:
        if isinstance(content, Mapping) and isinstance(content.get(name), Mapping):
            held = content[name]
            break
    if not isinstance(held, Mapping) or not held:
        raise ModelError(path, f"holds {_kind(held)}, not named tensors", expected=expected, action=action)
    for name, value in held.items():
        if not isinstance(name, str) or not isinstance(value, Tensor) or value.layout != torch.strided:
            problem = f"holds {_kind(value)} under {name!r}, beside or in place of tensors"
            raise ModelError(path, problem, expected=expected, action=action)
    return {name: value.detach() for name, value in held.items()}


def _kind(value: object) -> str:
    if isinstance(value, Tensor):
        return f"a tensor ({value.layout})"
    name = type(value).__name__
    return f"an empty {name}" if isinstance(value, Mapping) and not value else f"a value of type {name}"
