"""Files in the layout of MANO and HTML, made from the open hand: nothing licensed is needed in tests.

The pickles are written instruction by instruction as Python 2 wrote them, with chumpy objects, the
old module names of SciPy and NumPy and byte strings, so neither chumpy nor Python 2 is needed.
"""

import pickle
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from scipy import sparse

from datagen.hands.arm import wrist_cap
from datagen.hands.model import HandModel, load_open_hand, mirror_hand
from datagen.hands.skin import SkinBasis, load_open_skin

__all__ = [
    "left_faces_in_own_order",
    "mano_data",
    "python2_pickle",
    "texture_lookup",
    "uncapped",
    "write_html",
    "write_mano",
]

Side = Literal["right", "left"]


@dataclass(frozen=True)
class _Object:
    """An instance of a class of another package, with its attributes."""

    module: str
    name: str
    state: dict[str, Any]


def write_mano(
    folder: Path,
    *,
    sides: Sequence[Side] = ("right", "left"),
    model: HandModel | None = None,
    plain: bool = False,
    left_bug: bool = True,
) -> dict[Side, Path]:
    """MANO_RIGHT.pkl and MANO_LEFT.pkl of a right model (default: the open hand without its cap).

    `plain` writes the same numbers with Python 3 and without chumpy, as smplx can read them.
    `left_bug` repeats the official mistake: shapedirs of the left hand with the right hand's x.
    """
    folder.mkdir(parents=True, exist_ok=True)
    right = model or uncapped(load_open_hand())
    paths: dict[Side, Path] = {}
    for side in sides:
        own = right if side == "right" else left_faces_in_own_order(right)
        data = mano_data(own)
        if side == "left" and left_bug:
            data["shapedirs"] = data["shapedirs"] * np.array([-1.0, 1.0, 1.0])[:, None]
        paths[side] = folder / f"MANO_{side.upper()}.pkl"
        content = pickle.dumps(data, 2) if plain else python2_pickle(_with_chumpy(data))
        paths[side].write_bytes(content)
    return paths


def uncapped(model: HandModel) -> HandModel:
    """The model without the cap behind the wrist, open there as MANO is."""
    skin = ~wrist_cap(model.faces, model.wrist_loop)
    used = np.unique(model.faces[skin])
    number = np.full(len(model.v_template), -1)
    number[used] = np.arange(len(used))
    return replace(
        model,
        v_template=model.v_template[used],
        shapedirs=model.shapedirs[used],
        posedirs=model.posedirs[used],
        J_regressor=model.J_regressor[:, used],
        weights=model.weights[used],
        faces=number[model.faces[skin]],
        tip_ids=number[model.tip_ids],
        corner_uv=model.corner_uv[skin],
        wrist_loop=number[model.wrist_loop],
    )


def left_faces_in_own_order(right: HandModel) -> HandModel:
    """The left hand of a right one with its faces shuffled and turned: MANO's two files differ so."""
    left = mirror_hand(right)
    rng = np.random.default_rng(0)
    order = rng.permutation(len(left.faces))
    corner = (np.arange(3) + rng.integers(0, 3, (len(order), 1))) % 3
    return replace(
        left,
        faces=np.take_along_axis(left.faces[order], corner, axis=1),
        corner_uv=np.take_along_axis(left.corner_uv[order], corner[..., None], axis=1),
    )


def mano_data(model: HandModel) -> dict[str, Any]:
    """The keys of a MANO file with plain arrays."""
    parents = model.parents.astype(np.int64)
    parents[0] = 4294967295
    return {
        "hands_components": np.eye(45),
        "f": model.faces.astype(np.uint32),
        "J_regressor": sparse.csc_matrix(model.J_regressor),
        "kintree_table": np.stack([parents, np.arange(16)]),
        "J": model.J_regressor @ model.v_template,
        "hands_coeffs": np.zeros((2, 45)),
        "weights": model.weights,
        "posedirs": model.posedirs,
        "bs_style": "lbs",
        "hands_mean": model.hands_mean,
        "v_template": model.v_template,
        "shapedirs": model.shapedirs,
        "bs_type": "lrotmin",
    }


def _with_chumpy(data: dict[str, Any]) -> dict[str, Any]:
    """The same data with shapedirs as the official file has them: ten of twenty, selected by chumpy."""
    shapedirs = data["shapedirs"]
    twenty = np.concatenate([shapedirs, 7.0 + shapedirs], axis=2)
    n_verts, _, n_kept = shapedirs.shape
    idxs = np.arange(twenty.size).reshape(twenty.shape)[..., :n_kept].reshape(-1)
    variable = {"x": twenty, "_dirty_vars": {"x"}, "_itr": None, "_depends_on_deps": {}}
    select = {
        "a": _Object("chumpy.ch", "Ch", variable),
        "idxs": idxs,
        "preferred_shape": (n_verts, 3, n_kept),
        "_dirty_vars": {"a", "idxs", "preferred_shape"},
        "_make_dense": False,
    }
    return data | {"shapedirs": _Object("chumpy.reordering", "Select", select)}


def write_html(
    folder: Path,
    *,
    model: HandModel | None = None,
    skin: SkinBasis | None = None,
    variants: Sequence[str] = ("model_sr", "model_wosr"),
    uv_name: str = "uvs.pkl",
) -> None:
    """TextureBasis/ of a right model: the open skin in its UV layout, islands without a margin if given so."""
    right = model or uncapped(load_open_hand())
    basis = skin or load_open_skin()
    data = {
        "mean": basis.mean.astype(np.float64),
        "basis": basis.basis.astype(np.float64),
        "index_map": basis.index_map.astype(np.int64),
    }
    verts_uvs, faces_uvs = np.unique(right.corner_uv.reshape(-1, 2), axis=0, return_inverse=True)
    for variant in variants:
        place = folder / "TextureBasis" / variant
        place.mkdir(parents=True, exist_ok=True)
        (place / "model.pkl").write_bytes(pickle.dumps(data, 2))
    uvs = {"faces_uvs": faces_uvs.reshape(-1, 3), "verts_uvs": verts_uvs}
    (folder / "TextureBasis" / uv_name).write_bytes(pickle.dumps(uvs, 2))


def python2_pickle(value: Any) -> bytes:
    """Protocol 2 as Python 2 writes it: `str` are bytes, names are those of old NumPy and SciPy."""
    return pickle.PROTO + b"\x02" + _instructions(value) + pickle.STOP


def _instructions(value: Any) -> bytes:
    match value:
        case None:
            return pickle.NONE
        case bool():
            return pickle.NEWTRUE if value else pickle.NEWFALSE
        case int():
            return pickle.BININT + struct.pack("<i", value)
        case str():
            return _byte_string(value.encode("latin-1"))
        case tuple():
            return pickle.MARK + b"".join(map(_instructions, value)) + pickle.TUPLE
        case set():
            entries = b"".join(map(_instructions, sorted(value)))
            listed = pickle.EMPTY_LIST + pickle.MARK + entries + pickle.APPENDS + pickle.TUPLE1
            return _global("__builtin__", "set") + listed + pickle.REDUCE
        case dict():
            items = b"".join(_instructions(key) + _instructions(part) for key, part in value.items())
            return pickle.EMPTY_DICT + pickle.MARK + items + pickle.SETITEMS
        case np.ndarray():
            return _array_instructions(value)
        case sparse.csc_matrix():
            parts = {"data": value.data, "indices": value.indices, "indptr": value.indptr}
            state = {"_shape": value.shape, **parts, "maxprint": 50}
            return _instructions(_Object("scipy.sparse.csc", "csc_matrix", state))
        case _Object():
            made = _global(value.module, value.name) + pickle.EMPTY_TUPLE + pickle.NEWOBJ
            return made + _instructions(value.state) + pickle.BUILD
    raise TypeError(type(value))


def _array_instructions(array: np.ndarray) -> bytes:
    empty = (
        pickle.MARK + _global("numpy", "ndarray") + _instructions((0,)) + _instructions("b") + pickle.TUPLE
    )
    made = _global("numpy.core.multiarray", "_reconstruct") + empty + pickle.REDUCE
    kind = _call("numpy", "dtype", (array.dtype.str[1:], 0, 1))
    kind += _instructions((3, "<", None, None, None, -1, -1, 0)) + pickle.BUILD
    state = _instructions(1) + _instructions(array.shape) + kind + _instructions(False)
    return made + pickle.MARK + state + _byte_string(array.tobytes()) + pickle.TUPLE + pickle.BUILD


def _call(module: str, name: str, arguments: tuple[Any, ...]) -> bytes:
    return _global(module, name) + _instructions(arguments) + pickle.REDUCE


def _global(module: str, name: str) -> bytes:
    return pickle.GLOBAL + f"{module}\n{name}\n".encode()


def _byte_string(content: bytes) -> bytes:
    if len(content) < 256:
        return pickle.SHORT_BINSTRING + bytes([len(content)]) + content
    return pickle.BINSTRING + struct.pack("<i", len(content)) + content


def texture_lookup(
    texture: Float[np.ndarray, "row column 3"], uv: Float[np.ndarray, "*batch 2"]
) -> Float[np.ndarray, "*batch 3"]:
    """Bilinear colour at texture coordinates, as the renderer filters."""
    size = len(texture)
    x, y = np.moveaxis(np.stack([uv[..., 0], 1.0 - uv[..., 1]], axis=-1) * size - 0.5, -1, 0)
    x, y = np.clip(x, 0.0, size - 1.001), np.clip(y, 0.0, size - 1.001)
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    s, t = (x - column)[..., None], (y - row)[..., None]
    top = texture[row, column] * (1 - s) + texture[row, column + 1] * s
    bottom = texture[row + 1, column] * (1 - s) + texture[row + 1, column + 1] * s
    return top * (1 - t) + bottom * t
