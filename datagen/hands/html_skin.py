"""Reads HTML, the parametric hand texture model (Qian et al. 2020, handtracker.mpi-inf.mpg.de).

A folder TextureBasis with uvs.pkl and, per variant, model.pkl: with the shading of the scans removed
(model_sr) or left in (model_wosr).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from datagen.hands.model import HandModel
from datagen.hands.skin import SkinBasis, nearest_texels
from datagen.input_error import InputError
from datagen.restricted_pickle import load_restricted_pickle

__all__ = ["HtmlSkin", "find_html", "load_html_skin"]

_TEXTURE_PX = 1024
_WHOLE, _ANY = "iu", "iuf"  # kinds of NumPy numbers
_UV_NAMES = ("uvs.pkl", "uvs_right.pkl")  # the release, and the one for both hands
_ACTION = "Download HTML again from https://handtracker.mpi-inf.mpg.de/projects/HandTextureModel/."


@dataclass(frozen=True, kw_only=True, eq=False)
class HtmlSkin:
    """A texture model and where it lies on a hand."""

    basis: SkinBasis
    corner_uv: Float[np.ndarray, "face 3 2"]  # (0, 0) is the lower left of the texture


def load_html_skin(
    folder: Path,
    model: HandModel,
    *,
    right_faces: Int[np.ndarray, "right 3"] | None = None,
    variant: Literal["model_sr", "model_wosr"] = "model_sr",
    texture_px: int = _TEXTURE_PX,
) -> HtmlSkin:
    """The HTML model in `folder` (TextureBasis/ or what holds it) on the faces of a MANO hand.

    HTML's UV map belongs to the faces of the right model: `right_faces`, by default those of `model`.
    The faces of the left model, or of a mirrored right one, take it over vertex by vertex; both number
    their vertices alike. InputError names the file and the key, ValueError asks for `right_faces`.
    """
    if right_faces is None:
        if model.side == "left":
            raise ValueError(
                "load_html_skin needs right_faces, the faces of the right model, for a left hand"
            )
        right_faces = model.faces
    root = find_html(folder, variant)
    if root is None:
        raise _wrong(
            folder, f"holds no TextureBasis/{variant}/model.pkl", f"TextureBasis with {variant} and uvs.pkl"
        )
    basis = _basis(root / variant / "model.pkl", variant, texture_px)
    uv_paths = [root / name for name in _UV_NAMES]
    path = next((path for path in uv_paths if path.is_file()), uv_paths[0])
    return HtmlSkin(
        basis=basis, corner_uv=_uv_on(path, _corner_uv(path, len(right_faces)), right_faces, model)
    )


def find_html(folder: Path, variant: Literal["model_sr", "model_wosr"] = "model_sr") -> Path | None:
    """The TextureBasis folder in `folder` (or `folder` itself) that holds the variant, or None."""
    places = (folder / "TextureBasis", folder)
    return next((place for place in places if (place / variant / "model.pkl").is_file()), None)


def _wrong(path: Path, problem: str, expected: str) -> InputError:
    return InputError(path, problem, expected=expected, action=_ACTION)


def _arrays(path: Path, kinds: dict[str, str]) -> dict[str, np.ndarray]:
    """The named arrays of a file, each of one of the given kinds of NumPy type."""
    data: Any = load_restricted_pickle(path)
    if not isinstance(data, dict):
        raise _wrong(path, f"the file holds a {type(data).__name__}", f"a dict of {', '.join(kinds)}")
    for key, kind in kinds.items():
        if key not in data:
            found = ", ".join(sorted(str(name) for name in data))[:200]
            raise _wrong(path, f"the key {key} is missing", f"{', '.join(kinds)}, found {found}")
        if not isinstance(data[key], np.ndarray) or data[key].dtype.kind not in kind:
            found = getattr(data[key], "dtype", type(data[key]).__name__)
            raise _wrong(
                path, f"{key} is of type {found}", f"an array of {'whole ' * (kind == _WHOLE)}numbers"
            )
    return {key: data[key] for key in kinds}


def _basis(path: Path, variant: str, size: int) -> SkinBasis:
    data = _arrays(path, {"mean": _ANY, "basis": _ANY, "index_map": _WHOLE})
    mean, basis, index_map = data["mean"], data["basis"], data["index_map"]
    n = mean.size
    if mean.shape != (n,) or n == 0 or basis.ndim != 2 or len(basis) != n or index_map.shape != (n,):
        found = f"mean {mean.shape}, basis {basis.shape} and index_map {index_map.shape} disagree"
        raise _wrong(path, found, "shapes (n,), (n, coefficients) and (n,)")
    index_map = index_map.astype(np.int64)
    n_values = 3 * size**2
    if index_map.min() < 0 or index_map.max() >= n_values:
        found = f"index_map goes from {index_map.min()} to {index_map.max()}"
        raise _wrong(path, found, f"0 .. {n_values - 1}, the values of a texture of {size} pixels")
    if len(np.unique(index_map)) < n or len(np.unique(index_map // size**2)) < 3:
        raise _wrong(
            path, "index_map repeats values or leaves out a channel", "each value once, in 3 channels"
        )
    if not (np.isfinite(mean).all() and np.isfinite(basis).all()):
        raise _wrong(path, "mean or basis holds NaN or infinity", "finite numbers")
    if mean.max() <= 1.0:
        raise _wrong(path, f"mean goes up to {mean.max():.3g}", "colours of 0 .. 255")
    return SkinBasis(
        name=f"html {variant}",
        size=size,
        mean=mean.astype(np.float32),
        basis=basis.astype(np.float32),
        index_map=index_map,
        axes=("",) * basis.shape[1],
        anchors=np.zeros((0, basis.shape[1])),
        fill=nearest_texels(index_map, size),
    )


def _corner_uv(path: Path, n_faces: int) -> Float[np.ndarray, "face 3 2"]:
    data = _arrays(path, {"faces_uvs": _WHOLE, "verts_uvs": _ANY})
    faces_uvs, verts_uvs = data["faces_uvs"].astype(np.int64), data["verts_uvs"].astype(np.float64)
    if faces_uvs.shape != (n_faces, 3):
        found = f"faces_uvs has shape {faces_uvs.shape}"
        raise _wrong(path, found, f"({n_faces}, 3), the faces of the right hand model")
    if verts_uvs.ndim != 2 or verts_uvs.shape[1] != 2 or not np.isfinite(verts_uvs).all():
        raise _wrong(path, f"verts_uvs has shape {verts_uvs.shape} or is not finite", "(n, 2) finite numbers")
    if faces_uvs.min() < 0 or faces_uvs.max() >= len(verts_uvs):
        found = f"faces_uvs names the points {faces_uvs.min()} .. {faces_uvs.max()}"
        raise _wrong(path, found, f"0 .. {len(verts_uvs) - 1} of verts_uvs")
    return verts_uvs[faces_uvs]


def _uv_on(
    path: Path,
    right_uv: Float[np.ndarray, "right 3 2"],
    right_faces: Int[np.ndarray, "right 3"],
    model: HandModel,
) -> Float[np.ndarray, "face 3 2"]:
    """UV of the model's faces, each from the right face with the same three vertices."""
    right_row, right_corner, right_vertices = _sorted_faces(right_faces)
    row, corner, vertices = _sorted_faces(model.faces)
    if right_vertices.shape != vertices.shape or (right_vertices != vertices).any():
        found = f"the UV map is for other faces than those of the {model.side} hand {model.name!r}"
        raise _wrong(path, found, "the faces of right_faces, as MANO's two hands have")
    uv = np.empty((len(row), 3, 2))
    uv[row[:, None], corner] = right_uv[right_row[:, None], right_corner]
    return uv


def _sorted_faces(
    faces: Int[np.ndarray, "face 3"],
) -> tuple[Int[np.ndarray, " face"], Int[np.ndarray, "face 3"], Int[np.ndarray, "face 3"]]:
    """Rows and corners in the order that sorts the vertices of each face, then the faces; the vertices."""
    corner = np.argsort(faces, axis=1)
    vertices = np.take_along_axis(faces, corner, axis=1)
    row = np.lexsort(vertices.T)
    return row, corner[row], vertices[row]
