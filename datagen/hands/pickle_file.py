"""Reading the pickles of MANO and HTML without running what they name."""

import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["PickleLayoutError", "load_pickle"]

# What a table of arrays needs. Everything else in a pickle becomes an inert record of its state.
_ALLOWED = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("_codecs", "encode"),
}
_SPARSE = {"csc_matrix", "csr_matrix", "csc_array", "csr_array"}


class PickleLayoutError(ValueError):
    """A file is not the MANO or HTML pickle it was taken for."""


class _Record:
    """Stands for an object of a library that is not needed (chumpy); keeps its attributes only."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        del args, kwargs

    def __setstate__(self, state: Any) -> None:
        if isinstance(state, dict):
            self.__dict__.update(state)


class _ArrayUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _ALLOWED:
            return super().find_class(module, name)
        if module.startswith("scipy.sparse") and name in _SPARSE:
            import scipy.sparse

            return getattr(scipy.sparse, name)
        return type(name, (_Record,), {})


def load_pickle(path: Path) -> dict[str, Any]:
    """The arrays of a (Python 2 or 3) pickle of one dictionary, dense.

    chumpy arrays are resolved without chumpy: `Ch` by its `x`, a column selection by its source's
    leading columns. PickleLayoutError when the file is damaged or holds something else.
    """
    try:
        data = _ArrayUnpickler(io.BytesIO(path.read_bytes()), encoding="latin1").load()
    except (pickle.UnpicklingError, EOFError, AttributeError, IndexError, KeyError, ImportError, TypeError) as error:
        raise PickleLayoutError(f"{path}: not a readable pickle of arrays ({error}); download the file again") from error
    if not isinstance(data, dict):
        raise PickleLayoutError(f"{path}: expected one dictionary, found {type(data).__name__}")
    return {key: _plain(value) for key, value in data.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, _Record):
        state = vars(value)
        if "x" in state and "idxs" not in state:
            return _plain(state["x"])
        if "a" in state:  # chumpy.reordering.Select: flat indices into its source
            source = np.asarray(_plain(state["a"]))
            shape = state.get("preferred_shape")
            picked = source.reshape(-1)[np.asarray(state["idxs"], dtype=np.int64)]
            return picked.reshape(shape) if shape is not None else picked
        return value
    return value.toarray() if hasattr(value, "toarray") else value
