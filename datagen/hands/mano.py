"""Reads MANO_RIGHT.pkl and MANO_LEFT.pkl (Romero et al. 2017, mano.is.tue.mpg.de) without chumpy.

Every array is checked against the others; the number of vertices is free.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

from datagen.hands.model import PARENTS, HandModel, load_open_hand
from datagen.hands.skin_transfer import transferred_corner_uv
from datagen.input_error import InputError
from datagen.restricted_pickle import load_restricted_pickle
from shards.joints import DIGIT_JOINTS, DIGITS

__all__ = ["find_mano", "load_mano"]

Side = Literal["right", "left"]

_SUBFOLDERS = ("", "models", "mano", "mano_v1_2/models", "models/mano")  # of the official zip and of smplx
_N_BETAS = 10
_N_OFFICIAL_VERTS = 778
# Thumb to pinky, as in smplx, HOT3D and WiLoR. Both hands: their vertices correspond.
_OFFICIAL_TIPS = (744, 320, 443, 554, 671)
_ROOT_PARENTS = (4294967295, -1)  # of the official file (an unsigned -1), and of mended ones
_OTHER_MODELS = {24: "SMPL, a body", 52: "SMPL+H, a body", 55: "SMPL-X, a body", 5: "FLAME, a head"}
_REACH_M = (0.03, 0.3)  # wrist to the knuckle of the middle finger
_MAX_REGRESSOR = 16 * 10**6  # entries of a sparse matrix that are worth writing out
_SURE_CORRELATION = 0.1


def find_mano(folder: Path, side: Side) -> Path | None:
    """MANO_RIGHT.pkl or MANO_LEFT.pkl in a folder (or that file itself), or where the zip and smplx put it."""
    if folder.is_file() and folder.name == _file_name(side):
        return folder
    places = [folder / sub / _file_name(side) for sub in _SUBFOLDERS]
    return next((path for path in places if path.is_file()), None)


def load_mano(path: Path, side: Side) -> HandModel:
    """The model in a MANO file, or in a folder that has it (`find_mano`); rest frame, metres.

    Skin layout of the open hand (MANO has none of its own), ten shape coefficients. The shape
    directions of the official left hand, which have the wrong sign in x, are mended. InputError names
    the file, the key, what was expected and what was found.
    """
    if path.is_dir():
        found = find_mano(path, side)
        if found is None:
            raise InputError(
                path,
                f"the folder has no {_file_name(side)}",
                expected=f"{_file_name(side)} in it, or in models/ or mano/ below it",
                action=_use(side),
            )
        path = found
    model = _checked_model(path, side, load_restricted_pickle(path))
    return replace(model, corner_uv=transferred_corner_uv(load_open_hand(side), model))


def _file_name(side: Side) -> str:
    return f"MANO_{side.upper()}.pkl"


def _use(side: Side) -> str:
    return f"Use {_file_name(side)} of mano_v1_2 from https://mano.is.tue.mpg.de."


def _wrong(path: Path, side: Side, problem: str, expected: str) -> InputError:
    return InputError(path, problem, expected=expected, action=_use(side))


def _checked_model(path: Path, side: Side, data: Any) -> HandModel:
    """The model with an empty skin layout."""
    if not isinstance(data, dict):
        raise _wrong(path, side, f"the file holds a {type(data).__name__}", "a dict of arrays")
    _check_kinematic_tree(path, side, data)
    v_template = _array(path, side, data, "v_template", (-1, 3))
    n = len(v_template)
    regressor = _array(path, side, data, "J_regressor", (16, n))
    faces = _faces(path, side, data, n)
    weights = _array(path, side, data, "weights", (n, 16))
    if np.abs(weights.sum(axis=1) - 1.0).max() > 1e-3:
        raise _wrong(path, side, "weights: some rows do not sum to 1", "skinning weights that do")
    shapedirs = _array(path, side, data, "shapedirs", (n, 3, -1))
    if shapedirs.shape[2] < _N_BETAS:
        found = f"shapedirs has {shapedirs.shape[2]} shape coefficients"
        raise _wrong(path, side, found, f"at least {_N_BETAS}")
    joints = regressor @ v_template
    _check_side(path, side, joints)
    _check_outward(path, side, v_template[faces])
    shapedirs = shapedirs[..., :_N_BETAS]
    if side == "left":
        shapedirs = _mended_left_shapedirs(path, v_template, shapedirs)
    return HandModel(
        name="mano",
        side=side,
        v_template=v_template,
        shapedirs=shapedirs,
        posedirs=_array(path, side, data, "posedirs", (n, 3, 135)),
        J_regressor=regressor,
        weights=weights,
        faces=faces,
        parents=np.array(PARENTS),
        hands_mean=_array(path, side, data, "hands_mean", (45,)),
        tip_ids=_tip_ids(path, side, v_template, weights, joints),
        corner_uv=np.zeros((len(faces), 3, 2)),
        wrist_loop=_wrist_loop(path, side, faces, n),
    )


def _value(path: Path, side: Side, data: dict[Any, Any], key: str) -> np.ndarray:
    if key not in data:
        keys = ", ".join(sorted(str(name) for name in data))
        raise _wrong(path, side, f"the key {key} is missing", f"the keys of a MANO file, found {keys[:200]}")
    value = data[key]
    if isinstance(value, sparse.csc_matrix | sparse.csr_matrix):
        if value.shape[0] * value.shape[1] > _MAX_REGRESSOR:
            raise _wrong(path, side, f"{key} has shape {value.shape}", "(16, vertices)")
        value = value.toarray()
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        found = f"array of {value.dtype}" if isinstance(value, np.ndarray) else type(value).__name__
        raise _wrong(path, side, f"{key} is a {found}", "an array of numbers")
    return value


def _array(
    path: Path, side: Side, data: dict[Any, Any], key: str, shape: tuple[int, ...]
) -> Float[np.ndarray, "..."]:
    """Finite numbers of the given shape (-1: any length)."""
    value = _value(path, side, data, key)
    if len(value.shape) != len(shape) or any(n not in (-1, m) for n, m in zip(shape, value.shape)):
        wanted = str(shape).replace("-1", "any")
        raise _wrong(path, side, f"{key} has shape {value.shape}", wanted)
    if not np.isfinite(value).all():
        raise _wrong(path, side, f"{key} holds NaN or infinity", "finite numbers")
    return value.astype(np.float64)


def _check_kinematic_tree(path: Path, side: Side, data: dict[Any, Any]) -> None:
    tree = _value(path, side, data, "kintree_table")
    n_joints = tree.shape[-1] if tree.ndim else 0
    if n_joints in _OTHER_MODELS:
        found = f"this is {_OTHER_MODELS[n_joints]} model (kintree_table has {n_joints} joints)"
        raise _wrong(path, side, found, "MANO, a hand model with 16 joints")
    if tree.shape != (2, 16):
        raise _wrong(path, side, f"kintree_table has shape {tree.shape}", "(2, 16)")
    parents, joints = tree.astype(np.int64).tolist()
    if parents[0] not in _ROOT_PARENTS or tuple(parents[1:]) != PARENTS[1:] or joints != list(range(16)):
        found = f"kintree_table has the parents {parents} of the joints {joints}"
        raise _wrong(path, side, found, f"4294967295 or -1, then {list(PARENTS[1:])}, of the joints 0 .. 15")


def _faces(path: Path, side: Side, data: dict[Any, Any], n_verts: int) -> Int[np.ndarray, "face 3"]:
    faces = _value(path, side, data, "f")
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0 or faces.dtype.kind not in "iu":
        found = f"f is an array of {faces.dtype} of shape {faces.shape}"
        raise _wrong(path, side, found, "whole numbers of shape (faces, 3)")
    faces = faces.astype(np.int64)
    if faces.min() < 0 or faces.max() >= n_verts:
        found = f"f names the vertices {faces.min()} .. {faces.max()}"
        raise _wrong(path, side, found, f"vertices 0 .. {n_verts - 1} of v_template")
    return faces


def _check_side(path: Path, side: Side, joints: Float[np.ndarray, "16 3"]) -> None:
    """Right hands point to -x from the wrist, left hands to +x, in metres."""
    reach = joints[DIGIT_JOINTS["middle"][0]] - joints[0]
    length = float(np.linalg.norm(reach))
    if not _REACH_M[0] < length < _REACH_M[1]:
        found = f"v_template and J_regressor put the middle knuckle {length:.4g} from the wrist"
        raise _wrong(path, side, found, "a hand in metres, about 0.09")
    if abs(reach[0]) < 0.7 * length:
        raise _wrong(path, side, "v_template is turned: the fingers do not lie along x", "MANO's rest pose")
    found_side = "right" if reach[0] < 0.0 else "left"
    if found_side != side:
        found = f"this is the model of a {found_side} hand (the fingers of v_template point to "
        found += "-x)" if found_side == "right" else "+x)"
        raise _wrong(path, side, found, f"a {side} hand; the files may have changed names")


def _check_outward(path: Path, side: Side, triangles: Float[np.ndarray, "face 3 3"]) -> None:
    a, b, c = np.moveaxis(triangles - triangles.mean(axis=(0, 1)), 1, 0)
    if np.einsum("fi,fi->", a, np.cross(b, c)) <= 0.0:
        raise _wrong(path, side, "f: the faces look inward", "faces counter-clockwise seen from outside")


def _mended_left_shapedirs(
    path: Path, v_template: Float[np.ndarray, "vert 3"], shapedirs: Float[np.ndarray, "vert 3 beta"]
) -> Float[np.ndarray, "vert 3 beta"]:
    """Shape directions that mirror the right hand's; the official file repeats their x unmirrored.

    Over the people that the coefficients (variance 1) stand for, long hands are broad hands: the
    stretch along x and along z must go together. The wrong sign turns exactly that around.
    """
    centered = v_template - v_template.mean(axis=0)
    stretch = np.einsum("vc,vck->ck", centered, shapedirs) / (centered**2).sum(axis=0)[:, None]
    length, breadth = stretch[0], stretch[2]
    norm = float(np.linalg.norm(length) * np.linalg.norm(breadth))
    correlation = float(length @ breadth) / norm if norm > 0.0 else 0.0
    if abs(correlation) < _SURE_CORRELATION:
        found = f"shapedirs: length and breadth of the hand correlate by {correlation:.2f}"
        raise _wrong(path, "left", found, "a clear sign, from which that of x is known")
    return shapedirs if correlation > 0.0 else shapedirs * np.array([-1.0, 1.0, 1.0])[:, None]


def _tip_ids(
    path: Path,
    side: Side,
    v_template: Float[np.ndarray, "vert 3"],
    weights: Float[np.ndarray, "vert 16"],
    joints: Float[np.ndarray, "16 3"],
) -> Int[np.ndarray, "5"]:
    """Thumb to pinky. The published vertices on MANO's own mesh, else the farthest along each last bone."""
    bone = weights.argmax(axis=1)
    last = [DIGIT_JOINTS[digit][2] for digit in DIGITS]
    if len(v_template) == _N_OFFICIAL_VERTS and bone[list(_OFFICIAL_TIPS)].tolist() == last:
        return np.array(_OFFICIAL_TIPS)
    tips = []
    for digit, joint in zip(DIGITS, last):
        skin = np.flatnonzero(bone == joint)
        if len(skin) == 0:
            raise _wrong(path, side, f"weights: no vertex belongs to the last bone of the {digit}", "some")
        along = v_template[skin].mean(axis=0) - joints[joint]
        tips.append(skin[np.argmax(v_template[skin] @ along)])
    return np.array(tips, dtype=np.int64)


def _wrist_loop(path: Path, side: Side, faces: Int[np.ndarray, "face 3"], n: int) -> Int[np.ndarray, " loop"]:
    """The border of the mesh, running with the edges of the faces that lie on it."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    code = edges[:, 0] * n + edges[:, 1]
    border = edges[~np.isin(code, edges[:, 1] * n + edges[:, 0])]
    following = dict(border.tolist())
    if len(np.unique(code)) < len(code) or len(following) < len(border):
        raise _wrong(
            path, side, "f: the faces do not form a surface", "at most two faces, of one sense, per edge"
        )
    if not following:
        raise _wrong(path, side, "f: the mesh is closed", "a mesh open at the wrist, as MANO's")
    loop = [min(following)]
    while (vert := following[loop[-1]]) != loop[0]:
        loop.append(vert)
    if len(loop) < len(following):
        raise _wrong(path, side, "f: the mesh has several openings", "one opening, at the wrist")
    return np.array(loop)
