"""Tensors out of a torch checkpoint of unknown origin, without running anything that it names.

`torch.load(weights_only=True)` refuses Lightning's files: their hyper-parameters are objects (yacs nodes,
paths, enums). Here tensors are rebuilt, and every other global of the file becomes an inert stand-in that
takes whatever it is given and keeps nothing.
"""

import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor
from torch._utils import _rebuild_parameter, _rebuild_tensor_v2

from model.errors import ModelError
from model.tensor_files.torch_file import is_torchscript

__all__ = ["load_state_dict"]


def load_state_dict(path: Path, *, action: str) -> dict[str, Tensor]:
    """The tensors under "state_dict" of a zipped torch checkpoint (or all, if it is a plain state dict).

    On the CPU, mapped from the file rather than read. ModelError, ending in `action`, when it is none.
    """
    expected = "a checkpoint written by torch.save, with tensors under 'state_dict'"
    _check_zip(path, expected=expected, action=action)
    try:
        content = torch.load(
            path, map_location="cpu", mmap=True, weights_only=False, pickle_module=_RESTRICTED
        )
    except Exception as error:  # broken pickles raise nearly anything
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise ModelError(path, f"cannot be read ({reason})", expected=expected, action=action) from error
    held = content.get("state_dict", content) if isinstance(content, dict) else None
    if not isinstance(held, dict):
        raise ModelError(path, "holds no state dict", expected=expected, action=action)
    tensors = {
        name: value for name, value in held.items() if isinstance(name, str) and isinstance(value, Tensor)
    }
    if not tensors:
        raise ModelError(path, "holds no tensors", expected=expected, action=action)
    return tensors


def _check_zip(path: Path, *, expected: str, action: str) -> None:
    if not path.is_file():
        raise ModelError(path, "there is no such file", expected=expected, action=action)
    if not zipfile.is_zipfile(path):
        raise ModelError(path, "is no zip archive", expected=expected, action=action)
    if is_torchscript(path):
        raise ModelError(path, "is a TorchScript program", expected=expected, action=action)


class _Sealed(type):
    """Class that cannot be changed: the pickle instruction BUILD may set attributes, also on classes."""

    def __setattr__(cls, name: str, value: object) -> None:
        raise pickle.UnpicklingError(f"the file sets the attribute {name!r} of a class")


class _StandIn(metaclass=_Sealed):
    """Stands for any class or function of the file and for what it makes: accepts all, keeps nothing."""

    __slots__ = ()

    def __new__(cls, *_: object, **__: object) -> "_StandIn":
        return super().__new__(cls)

    def __init__(self, *_: object, **__: object) -> None:
        pass

    def __call__(self, *_: object, **__: object) -> "_StandIn":
        return self

    def __setstate__(self, _: object) -> None:
        pass

    def __setitem__(self, _: object, __: object) -> None:
        pass

    def append(self, _: object) -> None:
        pass

    extend = add = append


class _Allowed:
    """A function that the file may call, but not change."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *arguments: object) -> object:
        return self._function(*arguments)

    def __setstate__(self, _: object) -> None:
        raise pickle.UnpicklingError("the file sets the state of a function")


_ALLOWED: dict[tuple[str, str], object] = {
    ("collections", "OrderedDict"): OrderedDict,
    ("torch._utils", "_rebuild_tensor_v2"): _Allowed(_rebuild_tensor_v2),
    ("torch._utils", "_rebuild_parameter"): _Allowed(_rebuild_parameter),
}


class _RestrictedUnpickler(pickle.Unpickler):
    """Names lead to tensors or to the stand-in; torch adds what finds their storages in the archive."""

    def find_class(self, module: str, name: str) -> Any:
        return _ALLOWED.get((module, name), _StandIn)


_RESTRICTED = SimpleNamespace(Unpickler=_RestrictedUnpickler, __name__="restricted_pickle")
